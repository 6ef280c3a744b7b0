"""Interrupts kept for the program while a library works that would end the process on them."""

from __future__ import annotations

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

__all__ = ["interrupts_held"]


@contextmanager
def interrupts_held() -> Iterator[None]:
    """Hold SIGINT and SIGTERM while the block works, then let them reach the handlers that were there before.

    Mmg installs handlers of its own, which leave the process at once, and leaves them behind. With other threads in the
    process, which could take the signal, it is not held: Mmg then ends the process, with exit code 1. Does nothing in
    other than the main thread.
    """
    if threading.current_thread() is not threading.main_thread() or not hasattr(signal, "pthread_sigmask"):
        yield
        return
    numbers = (signal.SIGINT, signal.SIGTERM)
    earlier = signal.pthread_sigmask(signal.SIG_BLOCK, numbers if _alone() else ())
    handlers = {number: signal.getsignal(number) for number in numbers}
    try:
        yield
    finally:
        for number, handler in handlers.items():
            if handler is not None:  # None: not Python's, and not ours to put back
                signal.signal(number, handler)
        signal.pthread_sigmask(signal.SIG_SETMASK, earlier)


def _alone() -> bool:
    """Whether this is the process's only thread, libraries' own included; False where the system does not tell."""
    try:
        return len(list(Path("/proc/self/task").iterdir())) == 1
    except OSError:
        return False
