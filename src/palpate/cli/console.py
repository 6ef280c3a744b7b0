"""Where a run talks while it works: progress on stderr, details in the log, standard output kept free."""

from __future__ import annotations

import ctypes
import logging
import os
import signal
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from types import FrameType

from palpate.errors import ConfigurationError, InputDataError, ResourceError
from palpate.images.named_labels import printable

__all__ = ["LOGGER", "Console", "close_log", "interruptible", "output_folder"]

LOGGER = logging.getLogger("palpate")
LOGGER.addHandler(logging.NullHandler())  # before there is a log file, messages reach the user as sentences only


@dataclass(frozen=True, slots=True)
class Console:
    """How a run talks while it works: progress on stderr, unless it was asked to be quiet."""

    quiet: bool
    began: float = field(default_factory=time.monotonic)

    def progress(self, message: str) -> None:
        """Tell what happens now, with the seconds since the start."""
        LOGGER.info(message)
        if not self.quiet:
            print(f"[{time.monotonic() - self.began:6.1f} s] {printable(message)}", file=sys.stderr, flush=True)


@contextmanager
def output_folder(folder: Path, heading: str) -> Iterator[None]:
    """Make and lock `folder`, and log there while the block works; `heading` is the log's first line.

    A case or an input that is refused leaves the folder as it was, log and all: its sentence says everything.
    """
    from palpate.study.lock import folder_lock
    from palpate.study.outputs import make_folder

    made = [path for path in (folder, *folder.parents) if not path.exists()]
    make_folder(folder)
    log = folder / "log.txt"
    size = log.stat().st_size if log.exists() else None
    try:
        with folder_lock(folder):
            _open_log(log)
            LOGGER.info(heading)
            try:
                with _stdout_kept_free(log):
                    yield
            except (ConfigurationError, InputDataError):
                close_log()
                _restore(log, size)
                raise
    finally:
        for path in made:
            with suppress(OSError):  # not empty: something was written
                path.rmdir()


@contextmanager
def interruptible() -> Iterator[None]:
    """While the block works, a request to terminate ends it as an interrupt from the keyboard does."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    earlier = signal.signal(signal.SIGTERM, _interrupt)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, earlier)


def _interrupt(number: int, frame: FrameType | None) -> None:
    del number, frame
    raise KeyboardInterrupt


class _LogFile(logging.FileHandler):
    """A log that falls silent when the disk is full: the outputs will say so in a sentence."""

    def handleError(self, record: logging.LogRecord) -> None:
        """Say nothing."""


def _open_log(path: Path) -> None:
    """Send what the library logs, and warnings of others, to `path`, after what stands there."""
    try:
        handler = _LogFile(path, encoding="utf-8", errors="backslashreplace")
    except OSError as error:
        raise ResourceError(f"cannot write {path}: {error.strerror}; choose another --output folder") from error
    handler.setFormatter(logging.Formatter("%(asctime)s %(levelname)s %(name)s: %(message)s"))
    logging.captureWarnings(capture=True)
    for logger in (LOGGER, logging.getLogger("py.warnings")):
        logger.addHandler(handler)
        logger.propagate = False
    LOGGER.setLevel(logging.INFO)


def close_log() -> None:
    """Let go of the log file."""
    logging.captureWarnings(capture=False)
    for logger in (LOGGER, logging.getLogger("py.warnings")):
        for handler in [handler for handler in logger.handlers if isinstance(handler, logging.FileHandler)]:
            logger.removeHandler(handler)
            with suppress(OSError):
                handler.close()
        logger.propagate = True


def _restore(log: Path, size: int | None) -> None:
    with suppress(OSError):
        if size is None:
            log.unlink()
        else:
            os.truncate(log, size)


@contextmanager
def _stdout_kept_free(log: Path) -> Iterator[None]:
    """While a command works, what C libraries print on the process's standard output goes to the log."""
    sys.stdout.flush()
    saved = os.dup(1)
    try:
        with log.open("ab") as file:
            os.dup2(file.fileno(), 1)
            yield
    finally:
        with suppress(OSError, AttributeError, TypeError):  # no C library to ask: nothing of it is buffered either
            ctypes.CDLL(None).fflush(None)
        os.dup2(saved, 1)
        os.close(saved)
