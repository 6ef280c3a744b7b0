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
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, nullcontext, suppress
from dataclasses import dataclass
from typing import TYPE_CHECKING, TextIO, cast

from palpate.cli.console import LOGGER, give_up, tell
from palpate.images.named_labels import printable
from palpate.progress import Forecast, Progress, Stage, Told, about

if TYPE_CHECKING:
    from rich.live import Live
    from rich.table import Table


TRUST = 0.1  # of the predicted time: how much of it must be over before its own pace outweighs the prediction
STEADY = 0.75  # of a stage: beyond, its share creeps, as nobody knows how much longer it takes
MOST = 0.99
PATIENCE_S = 8.0
WIDTH = 32
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
    bar, began = Bar(), time.monotonic()
    said: list[tuple[str, float]] = []

    def progress(sentence: str) -> None:
        """Tell what happens now."""
        LOGGER.info(sentence)
        said.append((sentence, time.monotonic()))
        if not quiet:
            bar.tell(sentence, fitted(f"[{time.monotonic() - began:6.1f} s] {printable(sentence)}", sys.stderr))

    def remind(over: threading.Event) -> None:
        """Say that the last thing still goes on."""
        reminded = began
        while not over.wait(0.1 * patience_s):
            sentence, since = said[-1] if said else ("starting", began)
            now = time.monotonic()
            if now - max(since, reminded) > patience_s and not bar.moves:
                reminded = now
                words = f"[{now - began:6.1f} s] still, after {now - since:.0f} s: {printable(sentence)}"
                tell(fitted(words, stream), stream)

    # a stream to the same place, which stays open while a library's own words on standard error are sent nowhere
    stream: TextIO | None = None if quiet else sys.stderr
    if stream is not None:
        with suppress(OSError, ValueError):  # closed, or no file
            stream = os.fdopen(os.dup(stream.fileno()), "w", encoding=stream.encoding)
    try:
        with nullcontext() if quiet else _beside(remind):
            yield progress
    finally:
        bar.close()
        if stream is not sys.stderr and stream is not None:
            stream.close()


def fitted(line: str, stream: TextIO | None) -> str:
    """A line broken between words, where `stream` is a terminal that is narrower; what follows is set in."""
    try:
        if stream is None or not stream.isatty():
            return line
        width = os.get_terminal_size(stream.fileno()).columns
    except (OSError, ValueError):  # closed, or no terminal after all
        return line
    if not width // 2 > INDENT or len(line) < width:
        return line
    wrapper = textwrap.TextWrapper(width - 1, subsequent_indent=" " * INDENT)
    wrapper.break_long_words = wrapper.break_on_hyphens = False
    return wrapper.fill(line)


@contextmanager
def _beside(work: Callable[[threading.Event], None]) -> Iterator[None]:
    """While the block works, `work` does in a thread that no signal reaches; it is told when the block is over."""
    over = threading.Event()
    thread = threading.Thread(target=work, args=(over,), daemon=True)
    with _signals_blocked():
        thread.start()
    try:
        yield
    finally:
        over.set()
        thread.join()


class Bar:
    """A bar on stderr, below the lines of a run, once a forecast has come; none where that is no terminal."""

    def __init__(self) -> None:
        self._begun: Mapping[Stage, float] = {}
        self._seconds: Mapping[Stage, float] = {}
        self._share = 0.0
        self._live: Live | None = None

    @property
    def moves(self) -> bool:
        """Whether it is seen."""
        return self._live is not None

    def tell(self, sentence: str, line: str) -> None:
        """Take in what a sentence says of the run, and print its line."""
        if isinstance(sentence, Told):
            self._begun = {sentence.stage: time.monotonic(), **self._begun}  # a stage has begun once
        if isinstance(sentence, Forecast) and sum(sentence.seconds.values()) > 0.0:
            self._seconds = sentence.seconds
            if self._live is None and self._begun.keys() & sentence.seconds:
                self._live = _started(self)
        if self._live is None:
            tell(line, sys.stderr)
        else:
            with _signals_blocked():  # an interrupt in the midst of a line would leave the bar there
                self._live.console.print(line, markup=False, highlight=False, soft_wrap=True)

    def close(self) -> None:
        """Take the bar away."""
        live, self._live = self._live, None
        if live is not None:
            with _signals_blocked():
                live.stop()

    def __rich__(self) -> Table:
        """The bar as it is at this moment."""
        from rich.progress_bar import ProgressBar
        from rich.table import Table

        at = place(self._seconds, self._begun, time.monotonic())
        self._share = max(self._share, at.share)
        row = Table.grid(padding=(0, 1))
        bar = ProgressBar(total=1.0, completed=self._share, width=WIDTH, complete_style="green")
        row.add_row(f"{at.stage:13}", bar, f"{math.floor(100.0 * self._share)} %", f"{about(at.left)} left")
        return row


def _started(bar: Bar) -> Live | None:
    """The bar at work; None where stderr is no terminal that can be written over."""
    try:
        if sys.stderr is None or not sys.stderr.isatty():
            return None
    except ValueError:  # closed
        return None
    from rich.console import Console
    from rich.live import Live

    class Terminal(Console):
        """One whose cursor stays: a process that is killed cannot bring it back."""

        def show_cursor(self, show: bool = True) -> bool:
            """Leave it."""
            del show
            return False

    console = Terminal(file=cast("TextIO", _Unfailing(sys.stderr)), force_terminal=True)
    if not console.is_interactive:
        return None
    live = Live(
        bar, console=console, refresh_per_second=2, transient=True, redirect_stdout=False, redirect_stderr=False
    )
    try:
        with _signals_blocked():  # for ever in the bar's own thread: they reach the main one
            live.start()
    except BaseException:
        live.stop()
        raise
    return live


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


class _Unfailing:
    """A terminal that takes what it can: one that is closed, or lacks a letter, costs no run."""

    def __init__(self, stream: TextIO) -> None:
        self._stream = stream

    @property
    def encoding(self) -> str:
        """That of the stream."""
        return self._stream.encoding or "utf-8"

    def flush(self) -> None:
        """What is written is flushed."""

    def write(self, text: str) -> int:
        """Write what the stream can hold, letters that it lacks escaped."""
        try:
            self._stream.write(text.encode(self.encoding, "backslashreplace").decode(self.encoding))
            self._stream.flush()
        except (OSError, ValueError):
            give_up(self._stream)
        return len(text)
