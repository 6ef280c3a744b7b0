"""What a person sees while a run works: a line for each stage and, on a terminal or in a notebook, a bar below them.

The bar tells the stage, the share that is done and the time that is left, as `palpate check` predicts it. It never runs
backwards and is never full: its share is that of the stages that are over, and of the present one as far as time tells.
"""

from __future__ import annotations

import html
import math
import os
import signal
import sys
import textwrap
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import AbstractContextManager, contextmanager, nullcontext, suppress
from dataclasses import dataclass
from importlib import import_module
from typing import Any, TextIO, cast

from rich.console import Console
from rich.live import Live
from rich.progress_bar import ProgressBar
from rich.table import Table

from palpate.images.named_labels import printable
from palpate.progress import Forecast, Line, Progress, Stage, Told, Wanted, about, silent
from palpate.steps.streams import LOGGER, give_up, tell

TRUST = 0.1  # of the predicted time: how much of it must be over before its own pace outweighs the prediction
STEADY = 0.75  # of a stage: beyond, its share creeps, as nobody knows how much longer it takes
MOST = 0.99
PATIENCE_S = 30.0  # without a line, where no bar moves
REDRAWN_S = 1.0  # in a notebook
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


def shown_in_python(wanted: Wanted) -> AbstractContextManager[Progress]:
    """While the block works, what takes the sentences of a function that was called from Python.

    wanted: a function that is called with each sentence; "auto": lines and a bar in a notebook or on a terminal, and
    nothing elsewhere; True: lines on stderr there, too; False or None: nothing.
    """
    if callable(wanted):
        return nullcontext(wanted)
    if not wanted:
        return nullcontext(silent)
    if _in_notebook():
        return progress_in_notebook()
    return nullcontext(silent) if wanted == "auto" and not _is_terminal(sys.stderr) else progress_on_stderr()


def _is_terminal(stream: TextIO | None) -> bool:
    try:
        return stream is not None and stream.isatty()
    except ValueError:  # closed
        return False


def _in_notebook() -> bool:
    ipython = sys.modules.get("IPython")  # a notebook has loaded it
    return ipython is not None and getattr(ipython.get_ipython(), "kernel", None) is not None


@contextmanager
def progress_on_stderr(
    *, quiet: bool = False, verbose: bool = False, patience_s: float = PATIENCE_S
) -> Iterator[Progress]:
    """While the block works, what takes its sentences: all go to the log, lines with the seconds so far to stderr.

    verbose: details go there, too. Where no bar moves, a line follows every `patience_s` seconds without another: what
    it is that takes so long, and how far it is.
    """
    bar, began = Bar(), time.monotonic()
    said: list[tuple[str, float]] = []

    def progress(sentence: str) -> None:
        """Tell what happens now."""
        LOGGER.info(sentence)
        new = bar.hear(sentence)
        if not quiet and (new or verbose):
            said.append((sentence, time.monotonic()))
            bar.show(fitted(f"{_clock(began)} {printable(sentence)}", sys.stderr))

    def remind(over: threading.Event) -> None:
        """Say that it still goes on."""
        reminded = began
        while not over.wait(0.1 * patience_s):
            sentence, since = said[-1] if said else ("starting", began)
            now = time.monotonic()
            if now - max(since, reminded) > patience_s and not bar.moves:
                reminded = now
                tell(fitted(f"{_clock(began)} still at work: {bar.where() or printable(sentence)}", stream), stream)

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


@contextmanager
def progress_in_notebook() -> Iterator[Progress]:
    """The same in the output of a notebook's cell, without a widget: lines, and below them a bar while it works."""
    course, lines, began = Course(), list[str](), time.monotonic()

    def content(*, over: bool = False) -> dict[str, Any]:
        """The cell's output as HTML and as text; the bar is gone when all is over."""
        where, text = course.where(), "\n".join(lines)
        bar = f'<progress max="1" value="{course.share:.3f}"></progress> {html.escape(where)}'
        page = f"<pre>{html.escape(text)}</pre>{'' if over or not where else bar}"
        return {"text/html": page, "text/plain": text if over or not where else f"{text}\n{where}"}

    cell = import_module("IPython.display").display(content(), raw=True, display_id=True)

    def progress(sentence: str) -> None:
        """Tell what happens now."""
        LOGGER.info(sentence)
        if course.hear(sentence):
            lines.append(f"{_clock(began)} {printable(sentence)}")
            cell.update(content(), raw=True)

    def redraw(over: threading.Event) -> None:
        """Move the bar on."""
        while not over.wait(REDRAWN_S):
            cell.update(content(), raw=True)

    try:
        with _beside(redraw):
            yield progress
    finally:
        cell.update(content(over=True), raw=True)


def _clock(began: float) -> str:
    return f"[{time.monotonic() - began:6.1f} s]"


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


class Course:
    """How far a run is, by what was heard of it; nothing can be said before a forecast has come."""

    def __init__(self) -> None:
        self._begun: Mapping[Stage, float] = {}
        self._seconds: Mapping[Stage, float] = {}
        self._forecast = ""
        self.share = 0.0

    @property
    def known(self) -> bool:
        """Whether there is something to say."""
        return sum(self._seconds.values()) > 0.0 and bool(self._begun.keys() & self._seconds)

    def hear(self, sentence: str) -> bool:
        """Take in what a sentence says of the run; whether it is new to the person who waits."""
        if isinstance(sentence, Told | Line) and sentence.stage is not None:
            self._begun = {sentence.stage: time.monotonic(), **self._begun}  # a stage has begun once
        if isinstance(sentence, Forecast):
            known, self._forecast, self._seconds = self._forecast, str(sentence), sentence.seconds
            return self._forecast != known
        return isinstance(sentence, Line)

    def now(self) -> Place:
        """The place at this moment, whose share never falls; of a course that is known."""
        at = place(self._seconds, self._begun, time.monotonic())
        self.share = max(self.share, at.share)
        return Place(at.stage, self.share, at.left)

    def where(self) -> str:
        """The place in words; empty where nothing is known."""
        return "" if not self.known else "{}, {}, {}".format(*in_words(self.now()))


def in_words(at: Place) -> tuple[str, str, str]:
    """Stage, share and time left."""
    return at.stage, f"{math.floor(100.0 * at.share)} %", f"{about(at.left)} left"


class Bar(Course):
    """A bar on stderr, below the lines of a run, once its course is known; none where that is no terminal."""

    def __init__(self) -> None:
        super().__init__()
        self._live: Live | None = None

    @property
    def moves(self) -> bool:
        """Whether it is seen."""
        return self._live is not None

    def show(self, line: str) -> None:
        """Print a line above the bar, which begins with the first line after which there is something to say."""
        if self._live is None and self.known:
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
        stage, share, left = in_words(self.now())
        row = Table.grid(padding=(0, 1))
        bar = ProgressBar(total=1.0, completed=self.share, width=WIDTH, complete_style="green")
        row.add_row(f"{stage:13}", bar, share, left)
        return row


def _started(bar: Bar) -> Live | None:
    """The bar at work; None where stderr is no terminal that can be written over."""
    if not _is_terminal(sys.stderr):
        return None

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
