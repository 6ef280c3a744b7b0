"""The parts of an experiment, shared out among processes; what is finished stands in the ledger at once.

Parts that need the same meshes and factorisations make one job, so that one process computes them. A worker process
has one thread of linear algebra for itself: two processes on two cores are faster than two threads in one.
"""

from __future__ import annotations

import os
import signal
from collections.abc import Callable, Generator, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from multiprocessing import connection, get_context
from multiprocessing.connection import Connection
from typing import Any

from palpate.errors import ResourceError
from palpate.experiments.reproduce.ledger import Ledger, Part
from palpate.parallel import processors

__all__ = ["Job", "Progress", "compute"]

Progress = Callable[[str], None]

THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
GRACE = 5.0  # seconds that an ended process has to go


@dataclass(frozen=True, slots=True)
class Job:
    """Parts (by their keys in the ledger) that one process makes one after the other, by `make(key, progress)`.

    `make` travels to the process: a function of a module, or a `functools.partial` of one with plain arguments.
    """

    keys: tuple[str, ...]
    make: Callable[[str, Progress], Mapping[str, Any]]


def compute(jobs: Sequence[Job], ledger: Ledger, *, workers: int, progress: Progress) -> dict[str, Part]:
    """All parts by key: from the ledger, or made by `workers` processes (1: by this one) and written into it.

    Raises what a part raises, and `ResourceError` when a process ends without a word.
    """
    parts = ledger.finished()
    left = [Job(keys, job.make) for job in jobs if (keys := tuple(key for key in job.keys if key not in parts))]
    total, count = sum(len(job.keys) for job in jobs), sum(len(job.keys) for job in left)
    if count < total:
        progress(f"{total - count} of {total} parts are already computed")
    made = ((key, dict(job.make(key, progress))) for job in left for key in job.keys)
    if min(workers, len(left)) > 1:
        made = _made_by(left, workers, progress)
    for done, (key, part) in enumerate(made, start=total - count + 1):
        parts[key] = ledger.keep(key, part)
        progress(f"part {done} of {total} done: {key}")
    return parts


def _made_by(jobs: Sequence[Job], workers: int, progress: Progress) -> Generator[tuple[str, Part]]:
    context = get_context("spawn")
    waiting = list(jobs)
    pipes = [context.Pipe() for _ in range(min(workers, len(jobs)))]
    processes = [context.Process(target=_work, args=(theirs,), daemon=True) for _, theirs in pipes]
    try:
        with _threads(max(1, processors() // len(pipes))):
            for process in processes:
                process.start()
        for _, theirs in pipes:
            theirs.close()
        busy = [ours for ours, _ in pipes]
        while busy:
            for pipe in connection.wait(busy):
                assert isinstance(pipe, Connection)
                yield from _heard(pipe, waiting, busy, progress)
    finally:
        for process in processes:
            process.terminate()
        for process in processes:
            process.join(GRACE)


def _heard(
    pipe: Connection, waiting: list[Job], busy: list[Connection], progress: Progress
) -> Iterator[tuple[str, Part]]:
    """Take one message of a worker: the part in it, if it is one; the worker's next job, if it asks for it."""
    try:
        kind, content = pipe.recv()
    except EOFError as error:
        raise ResourceError(
            "a process of the experiment ended before its part was done, most likely for want of memory; the same"
            " command goes on with the parts that are left"
        ) from error
    if kind == "part":
        yield content
    elif kind == "progress":
        progress(content)
    elif kind == "error":
        raise content
    elif waiting:
        pipe.send(waiting.pop(0))
    else:
        pipe.send(None)
        busy.remove(pipe)


def _work(pipe: Connection) -> None:
    """A worker process: asks for jobs until there are none."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the process that started this one ends it
    with suppress(BrokenPipeError, EOFError):
        try:
            pipe.send(("ready", None))
            while (job := pipe.recv()) is not None:
                for key in job.keys:
                    pipe.send(("part", (key, dict(job.make(key, lambda text: pipe.send(("progress", text)))))))
                pipe.send(("ready", None))
        except Exception as error:  # raised again where the experiment was asked for
            pipe.send(("error", error))


@contextmanager
def _threads(number: int) -> Iterator[None]:
    """Processes started meanwhile have that many threads of linear algebra each."""
    before = {name: os.environ.get(name) for name in THREADS}
    os.environ.update(dict.fromkeys(THREADS, str(number)))
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value
