"""Interrupts kept for the program while a library works that would end the process on them."""

from __future__ import annotations

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path


@contextmanager
def interrupts_held() -> Iterator[None]:
    """Hold SIGINT and SIGTERM while the block works, then let them reach the handlers that were there before.

    Mmg installs handlers of its own, which leave the process at once, and leaves them behind. Where another thread of
    the process could take the signal, it is not held: Mmg then ends the process, with exit code 1. The command line
    starts the threads of the linear algebra so that they never take one. Does nothing in other than the main thread.
    """
    if threading.current_thread() is not threading.main_thread() or not hasattr(signal, "pthread_sigmask"):
        yield
        return
    numbers = (signal.SIGINT, signal.SIGTERM)
    earlier = signal.pthread_sigmask(signal.SIG_BLOCK, numbers if _others_take_none(numbers) else ())
    handlers = {number: signal.getsignal(number) for number in numbers}
    try:
        yield
    finally:
        for number, handler in handlers.items():
            if handler is not None:  # None: not Python's, and not ours to put back
                signal.signal(number, handler)
        signal.pthread_sigmask(signal.SIG_SETMASK, earlier)


def _others_take_none(numbers: tuple[signal.Signals, ...]) -> bool:
    """Whether every other thread, libraries' own included, blocks the signals; False where the system cannot tell."""
    mask = sum(1 << (number - 1) for number in numbers)
    try:
        others = [task for task in Path("/proc/self/task").iterdir() if task.name != str(threading.get_native_id())]
        statuses = [(task / "status").read_text(encoding="ascii", errors="replace") for task in others]
        blocked = [int(status.partition("\nSigBlk:")[2].split()[0], 16) for status in statuses]  # a bit a signal
    except (OSError, ValueError, IndexError):
        return False
    return all(bits & mask == mask for bits in blocked)
