"""What a run says is kept apart: sentences on stderr, details in the log, standard output free for results.

What is said to a person never decides a run: a terminal that is closed, a full disk or a reader that has left takes the
words and nothing else.
"""

from __future__ import annotations

import ctypes
import logging
import os
import signal
import sys
import threading
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager, nullcontext, suppress
from importlib import import_module
from pathlib import Path
from types import FrameType
from typing import TextIO

from palpate.errors import ConfigurationError, InputDataError
from palpate.steps.streams import LOGGER, give_up, tell
from palpate.study.lock import own_file
from palpate.study.outputs import OutputFolder

LOGGER.addHandler(logging.NullHandler())  # before there is a log file, messages reach the user as sentences only
UNLOCKED = "the file system of %s knows no locks: a second run in the folder would not be noticed, so start none there"


def close_streams() -> None:
    """Empty the standard streams, so that their end at the interpreter's hand cannot fail."""
    for stream in (sys.stdout, sys.stderr):
        try:
            if stream is not None:
                stream.flush()
        except (OSError, ValueError):
            give_up(stream)


@contextmanager
def output_folder(outputs: OutputFolder, heading: str, *, logs: bool) -> Iterator[None]:
    """Make and hold the folder and, if it `logs`, write a log there while the block works, `heading` its first line.

    A case or an input that is refused leaves the folder as it was, log and all: its sentence says everything.
    """
    folder = outputs.path
    with outputs.held() as locked, _logged(folder / "log.txt", heading) if logs else nullcontext():
        if not locked and sys.platform != "win32":
            LOGGER.warning(UNLOCKED, folder)
            tell(f"palpate: warning: {UNLOCKED % folder}", sys.stderr)
        yield


@contextmanager
def interruptible(signals: Sequence[signal.Signals], mask: Iterable[int]) -> Iterator[list[int]]:
    """While the block works, each of the `signals`, blocked until now, interrupts it; `mask`: what stays blocked.

    Gives the list of those that came: what they interrupt may make another exception of it, as class bodies do. What
    the process was told to ignore (by nohup, say) it ignores.
    """
    came: list[int] = []

    def interrupt(number: int, frame: FrameType | None) -> None:
        """End what is being done."""
        del frame
        came.append(number)
        raise KeyboardInterrupt

    if threading.current_thread() is not threading.main_thread():
        yield came
        return
    earlier = {number: signal.getsignal(number) for number in signals}
    ours = [number for number in signals if earlier[number] not in (signal.SIG_IGN, None)]
    try:
        for number in ours:
            signal.signal(number, interrupt)
        if hasattr(signal, "pthread_sigmask"):
            # The linear algebra starts its threads while the signals are blocked, and so they are for ever for these:
            # a signal reaches the main thread, or waits where that blocks it (`mesh.remeshing`).
            import_module("scipy.linalg")
            signal.pthread_sigmask(signal.SIG_SETMASK, mask)
        yield came
    finally:
        if hasattr(signal, "pthread_sigmask"):
            signal.pthread_sigmask(signal.SIG_BLOCK, signals)
        for number in ours:
            signal.signal(number, earlier[number])


class _LogFile(logging.StreamHandler[TextIO]):
    """A log that falls silent when the disk is full: the outputs will say so in a sentence."""

    def handleError(self, record: logging.LogRecord) -> None:
        """Say nothing."""


@contextmanager
def _logged(path: Path, heading: str) -> Iterator[None]:
    """Log to `path`, after what stands there; a case or an input that is refused leaves it as it was."""
    there = path.exists()
    file = own_file(path)
    size = os.fstat(file).st_size
    # send what the library logs, and warnings of others, to a copy of the open `file`
    stream = os.fdopen(os.dup(file), "a", encoding="utf-8", errors="backslashreplace")
    handler = _LogFile(stream)
    handler.setFormatter(logging.Formatter("%(asctime)s %(levelname)s %(name)s: %(message)s"))
    logging.captureWarnings(capture=True)
    for logger in (LOGGER, logging.getLogger("py.warnings")):
        logger.addHandler(handler)
        logger.propagate = False
    LOGGER.setLevel(logging.INFO)
    LOGGER.info(heading)
    try:
        with _stdout_kept_free(file):
            yield
    except (ConfigurationError, InputDataError):
        close_log()
        with suppress(OSError):
            os.ftruncate(file, size)
            if not there:
                path.unlink()
        raise
    finally:
        os.close(file)


def log_is_open() -> bool:
    """Whether there is a log that takes the details of what happens now."""
    return any(isinstance(handler, _LogFile) for handler in LOGGER.handlers)


def close_log() -> None:
    """Let go of the log file."""
    logging.captureWarnings(capture=False)
    for logger in (LOGGER, logging.getLogger("py.warnings")):
        for handler in [handler for handler in logger.handlers if isinstance(handler, _LogFile)]:
            logger.removeHandler(handler)
            with suppress(OSError):
                handler.stream.close()
        logger.propagate = True


@contextmanager
def _stdout_kept_free(log: int) -> Iterator[None]:
    """While a command works, what C libraries print on the process's standard output goes to the open file `log`."""
    with suppress(OSError, ValueError, AttributeError):
        sys.stdout.flush()
    saved = os.dup(1)
    try:
        os.dup2(log, 1)
        yield
    finally:
        with suppress(OSError, AttributeError, TypeError):  # no C library to ask: nothing of it is buffered either
            ctypes.CDLL(None).fflush(None)
        os.dup2(saved, 1)
        os.close(saved)
