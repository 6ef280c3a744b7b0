"""Where a run talks while it works: sentences on stderr, and on a terminal a bar below them.

The bar tells the stage, the share that is done and the time that is left, as `palpate check` predicts it. It never runs
backwards and is never full: its share is that of the stages that are over, and of the present one as far as time tells.
"""

from __future__ import annotations

import math
import os
import signal
import sys
import textwrap
import threading
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from typing import TextIO

from palpate.cli.console import LOGGER, give_up, tell
from palpate.images.named_labels import printable
from palpate.progress import Forecast, Progress, Stage, Told, about

TRUST = 0.1  # of the predicted time: how much of it must be over before its own pace outweighs the prediction
STEADY = 0.75  # of a stage: beyond, its share creeps, as nobody knows how much longer it takes
MOST = 0.99
PATIENCE_S = 8.0
WIDTH, MARKS = 32, "━─"  # of the bar
ERASED = "\r\x1b[2K"  # the line of the bar, whose place the next one takes
MOMENT_S = 0.25
INDENT = 11  # of what follows the time


@dataclass(frozen=True, slots=True)
class Place:
    """Where a run stands: the stage, the share that is done (0 to below 1), and the seconds that are left."""

    stage: Stage
    share: float
    left: float


def place(seconds: Mapping[Stage, float], begun: Mapping[Stage, float], now: float) -> Place:
    """Where a run stands at the time `now` whose stages were to take `seconds` and began at the times `begun` (s).

    The stages that are over give the pace, at which the others are expected.
    """
    known = [stage for stage in seconds if stage in begun]
    stage = max(known, key=lambda each: begun[each])
    names, first = list(seconds), min(begun[each] for each in known)
    total, over = sum(seconds.values()), sum(seconds[name] for name in names[: names.index(stage)])
    trust = TRUST * total
    pace = (begun[stage] - first + trust) / (over + trust)
    slower = (now - first + trust) / (over + seconds[stage] + trust)  # at least, where the present one takes long
    x, rest = (now - begun[stage]) / max(pace * seconds[stage], 1e-9), 1.0 - STEADY
    # follows x up to STEADY, then goes ever slower towards 1; its slope is continuous
    creeping = x if x <= STEADY else 1.0 - rest**2 / (rest + x - STEADY)
    there = over + seconds[stage] * creeping
    return Place(stage, min(there / total, MOST), max(pace, slower) * (total - there))


@contextmanager
def progress_on_stderr(*, quiet: bool, patience_s: float = PATIENCE_S) -> Iterator[Progress]:
    """While the block works, what takes its sentences: each goes to the log, and with the seconds so far to stderr.

    Where no bar moves there, a line follows every `patience_s` seconds without a sentence: a library that factorises or
    remeshes says nothing while it works.
    """
    stream = None if quiet else _duplicate(sys.stderr)  # before any library takes the place of standard error
    bar, began = Bar(stream), time.monotonic()
    said: list[tuple[str, float]] = []

    def progress(sentence: str) -> None:
        """Tell what happens now."""
        LOGGER.info(sentence)
        said.append((sentence, time.monotonic()))
        if not quiet:
            bar.tell(sentence, fitted(f"[{time.monotonic() - began:6.1f} s] {printable(sentence)}", sys.stderr))

    def remind(over: threading.Event) -> None:
        """Draw the bar, or say that the last thing still goes on."""
        reminded = began
        while not over.wait(min(0.1 * patience_s, MOMENT_S)):
            sentence, since = said[-1] if said else ("starting", began)
            now = time.monotonic()
            if bar.moves:
                bar.draw()
            elif now - max(since, reminded) > patience_s:
                reminded = now
                words = f"[{now - began:6.1f} s] still, after {now - since:.0f} s: {printable(sentence)}"
                tell(fitted(words, stream), stream)

    over = threading.Event()
    thread = threading.Thread(target=remind, args=(over,), daemon=True)
    try:
        if not quiet:
            with _signals_blocked():  # which never reach it
                thread.start()
        yield progress
    finally:
        over.set()
        if thread.is_alive():
            thread.join()
        bar.close()
        if stream is not sys.stderr and stream is not None:
            stream.close()


def fitted(line: str, stream: TextIO | None) -> str:
    """A line broken between words, where `stream` is a terminal that is narrower; what follows is set in."""
    width = _width(stream)
    if not width // 2 > INDENT or len(line) < width:
        return line
    wrapper = textwrap.TextWrapper(width - 1, subsequent_indent=" " * INDENT)
    wrapper.break_long_words = wrapper.break_on_hyphens = False
    return wrapper.fill(line)


def _width(stream: TextIO | None) -> int:
    """Letters of a line of a terminal; 0 where a stream is none."""
    try:
        return os.get_terminal_size(stream.fileno()).columns if stream is not None and stream.isatty() else 0
    except (OSError, ValueError):  # closed, or no terminal after all
        return 0


def _duplicate(stream: TextIO | None) -> TextIO | None:
    """A stream to the same place that stays open while a library's own words on standard error are sent nowhere."""
    try:
        return None if stream is None else os.fdopen(os.dup(stream.fileno()), "w", encoding=stream.encoding)
    except (OSError, ValueError):  # closed, or no file
        return stream


class Bar:
    """A bar on a terminal, below the lines of a run, once a forecast has come; none where `stream` is no terminal.

    What a terminal does not take costs no run.
    """

    def __init__(self, stream: TextIO | None) -> None:
        self._stream, self._lock, self._share = stream, threading.Lock(), 0.0
        self._begun: Mapping[Stage, float] = {}
        self._seconds: Mapping[Stage, float] = {}
        self.moves = False

    def tell(self, sentence: str, line: str) -> None:
        """Take in what a sentence says of the run, and print its line."""
        if isinstance(sentence, Told):
            self._begun = {sentence.stage: time.monotonic(), **self._begun}  # a stage has begun once
        if isinstance(sentence, Forecast) and sum(sentence.seconds.values()) > 0.0:
            self._seconds = sentence.seconds
            self.moves = self.moves or (bool(self._begun.keys() & sentence.seconds) and _takes_back(self._stream))
        if not self.moves:
            tell(line, sys.stderr)
            return
        with _signals_blocked(), self._lock:  # an interrupt in the midst of a line would leave the bar there
            self._write(f"{line}\n")
            self._draw()

    def draw(self) -> None:
        """Draw it as it is at this moment."""
        with self._lock:
            self._draw()

    def _draw(self) -> None:
        if self.moves:
            at = place(self._seconds, self._begun, time.monotonic())
            self._share = max(self._share, at.share)
            done, marks = math.floor(WIDTH * self._share), _marks(self._stream)
            marks = marks[0] * done + marks[1] * (WIDTH - done)
            text = f"{at.stage:13} {marks} {math.floor(100.0 * self._share)} % {about(at.left)} left"
            self._write(text[: (_width(self._stream) or 80) - 1])

    def _write(self, text: str) -> None:
        """Write in the place of what stands there; where that fails, nothing more is said on standard error."""
        if tell(f"{ERASED}{text}", self._stream, end="") is not None and sys.stderr is not None:
            give_up(sys.stderr)

    def close(self) -> None:
        """Take the bar away."""
        with _signals_blocked(), self._lock:
            if self.moves:
                self._write("")
            self.moves = False


def _takes_back(stream: TextIO | None) -> bool:
    """Whether what is written to a stream can be written over."""
    try:
        seen = stream is not None and stream.isatty()
    except ValueError:  # closed
        return False
    known = os.name != "nt" or "WT_SESSION" in os.environ or "TERM" in os.environ
    return seen and known and os.environ.get("TERM", "").lower() not in ("dumb", "unknown")


def _marks(stream: TextIO | None) -> str:
    """What is done and what is not, in letters that the stream has."""
    try:
        MARKS.encode(getattr(stream, "encoding", None) or "ascii")
    except UnicodeEncodeError:
        return "#-"
    return MARKS


@contextmanager
def _signals_blocked() -> Iterator[None]:
    if not hasattr(signal, "pthread_sigmask"):
        yield
        return
    mask = signal.pthread_sigmask(signal.SIG_BLOCK, (signal.SIGINT, signal.SIGTERM, signal.SIGHUP))
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, mask)
