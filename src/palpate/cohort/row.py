"""A row on a Dask worker: `palpate estimate` in a process of its own, watched for memory and time, and its mark."""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from importlib import import_module
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import IO

from palpate.case.file import case_text
from palpate.cohort.plan import read_mark, write_mark
from palpate.cohort.resolve import case_of, row_key
from palpate.cohort.task import CLASS_OF_EXIT_CODE, Limits, Outcome, Task
from palpate.errors import PalpateError
from palpate.images.named_labels import printable
from palpate.processes import environment_of_child, name_of_end
from palpate.study.outputs import make_folder, write_text

LOOK_S = 0.1  # how often memory is looked at
MUCH = 0.5  # of the limit on memory: a process that the system kills beyond that was most likely too large
INTERRUPTED = 130  # exit code of a command that a signal has ended
FROM_OUTSIDE = (-signal.SIGKILL, -signal.SIGTERM, -signal.SIGHUP, -signal.SIGINT, INTERRUPTED)
COMPLAINT = re.compile(r"^palpate: ", flags=re.MULTILINE)


class RowLostError(Exception):
    """Something from outside has ended the process of a row, so another attempt may succeed."""


def estimate_row(task: Task) -> Outcome:
    """Estimate the case of a row into its folder, and leave the mark; whatever the row does is an outcome.

    Raises `RowLostError`, upon which Dask tries again, and `ResourceError` where nothing can be written.
    """
    folder = Path(task.folder)
    earlier = read_mark(folder)
    if earlier is not None and earlier.key == task.key:
        return earlier  # of an attempt whose worker was lost afterwards
    try:
        case = case_text(case_of(task.row, task.overrides), folder)
    except PalpateError as error:
        outcome = Outcome.failed(task, CLASS_OF_EXIT_CODE[error.exit_code], printable(str(error)))
    else:
        outcome = _estimated(task, case)
    return write_mark(make_folder(folder), outcome)


def _estimated(task: Task, case: str) -> Outcome:
    """What `palpate estimate` makes of the text of a case file."""
    limits = task.limits
    if limits.memory_gb is None:
        limits = replace(limits, memory_gb=_share_gb())
    with TemporaryDirectory() as place, (Path(place) / "complaints.txt").open("w+b") as complaints:
        path = Path(place) / "case.toml"
        write_text(path, case)
        command = [*task.program, "estimate", str(path), "--output", task.folder, "--overwrite", "--quiet"]
        end = _run([sys.executable, *command], complaints, limits)
        complaints.seek(0)
        said = printable(COMPLAINT.split(complaints.read().decode(errors="replace"))[-1].strip().replace("\n", " "))
    if not end.stopped and end.code == 0:
        outcome = Outcome(task.row.id, "done", task.key)
        if row_key(task.row, task.overrides) != task.key:
            said = "an input was changed while it was used; run the cohort again, with --resume"
            outcome = Outcome.failed(task, "input", said)
    else:
        outcome = Outcome.failed(task, *_failure(end, limits, said))
    return replace(outcome, seconds=round(end.seconds, 3), peak_gb=round(end.peak_gb, 3))


@dataclass(frozen=True, slots=True)
class _End:
    """How a process ended: exit code or -signal, why we ended it ("memory", "time" or ""), and what it took."""

    code: int
    stopped: str
    seconds: float
    peak_gb: float


def _run(command: Sequence[str], complaints: IO[bytes], limits: Limits) -> _End:
    """Run a command, on one thread, until it ends or takes more than its limits.

    On one thread because several would sum in another order, and the numbers would tell in their last digits how many
    processors there were. Raises `RowLostError` where the cohort no longer wants it.
    """
    process = subprocess.Popen(  # noqa: S603 - our own interpreter and module, no shell
        command,
        stdin=subprocess.PIPE,
        stdout=subprocess.DEVNULL,
        stderr=complaints,
        env=environment_of_child(),
        process_group=0,
    )
    psutil = import_module("psutil")  # which Dask brings
    began, peak_gb, stopped = time.monotonic(), 0.0, ""
    try:
        while process.poll() is None and not stopped:
            with suppress(subprocess.TimeoutExpired):
                process.wait(LOOK_S)
            with suppress(psutil.Error):  # it has ended
                now_gb = psutil.Process(process.pid).memory_info().rss / 1e9
                peak_gb = max(peak_gb, now_gb)
            if peak_gb > (limits.memory_gb or float("inf")):
                stopped = "memory"
            elif time.monotonic() - began > limits.seconds:
                stopped = "time"
            elif _is_cancelled():
                raise RowLostError("the cohort that asked for the row has ended")
    finally:
        with suppress(OSError):
            os.killpg(process.pid, signal.SIGKILL)  # and what it has started
        code = process.wait()
        if process.stdin is not None:
            process.stdin.close()
    return _End(code, stopped, time.monotonic() - began, peak_gb)


def _failure(end: _End, limits: Limits, said: str) -> tuple[str, str]:
    """Class and sentence of a failure; said: the last complaint on standard error. Raises `RowLostError`."""
    memory_gb = limits.memory_gb or float("inf")
    if end.stopped == "time":
        return "timeout", f"it took more than the {limits.seconds:g} s that it was given (--time-limit)"
    if end.stopped == "memory":
        advice = "set --memory-limit, or take fewer --workers, which leave more to each"
        return "resources", f"it took more than the {memory_gb:.1f} GB of memory that it was given: {advice}"
    if end.code == -signal.SIGKILL and end.peak_gb > MUCH * memory_gb:
        return "resources", f"the system ended it at {end.peak_gb:.1f} GB of memory, most likely for want of more"
    if end.code in FROM_OUTSIDE:
        raise RowLostError(f"something ended the process that computed it ({name_of_end(end.code)})")
    if end.code < 0:
        return "crash", f"the process that computed it crashed ({name_of_end(end.code)}); its log.txt may tell why"
    return CLASS_OF_EXIT_CODE.get(end.code, "crash"), said or name_of_end(end.code)


def _share_gb() -> float | None:
    """Memory (GB) that the Dask worker of this thread has for each of its threads; None without a limit."""
    worker = import_module("distributed").get_worker()
    limit = worker.memory_manager.memory_limit
    return float(limit) / worker.state.nthreads / 1e9 if limit else None


def _is_cancelled() -> bool:
    """Whether Dask has cancelled the task of this thread, as it does when the run has ended; False outside of Dask."""
    try:
        worker = import_module("distributed").get_worker()
    except ValueError:
        return False
    task = worker.state.tasks.get(worker.get_current_task())
    return task is None or task.state == "cancelled"
