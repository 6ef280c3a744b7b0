"""The engine of this machine: some warm processes, each with a child at a time."""

from __future__ import annotations

import os
import queue
from collections.abc import Hashable, Iterator, Mapping, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
from dataclasses import dataclass

from palpate.cohort.engines.packing import Place, packed
from palpate.cohort.supervise import ESTIMATE, Supervisor
from palpate.cohort.task import Outcome, Task
from palpate.errors import ResourceError
from palpate.memory import available_memory
from palpate.parallel import processors

__all__ = ["LocalEngine"]

HERE = "here"
UNKNOWN_GB = 1e6  # where the system does not tell what is free
SHARE = 0.9  # of the free memory: predictions are rough, and other programs run, too
MOMENT_S = 1.0


@dataclass(frozen=True, slots=True)
class LocalEngine:
    """So many workers (None: one a processor) with so much memory (GB, None: what is free), as children of this one.

    work: "module:function" that a task is done with.
    """

    workers: int | None = None
    memory_gb: float | None = None
    work: str = ESTIMATE

    @property
    def name(self) -> str:
        """As `--engine` calls it."""
        return "local"

    def outcomes(self, tasks: Sequence[Task]) -> Iterator[Outcome]:
        """The outcome of each task; memory is shared by what is predicted. Raises `ResourceError` on Windows."""
        if not hasattr(os, "fork"):
            raise ResourceError("cohorts need a system that forks processes: Linux or macOS, or a Dask worker on one")
        workers = max(min(self.workers or processors(), len(tasks)), 1)
        pool = _Processes([Supervisor(self.work) for _ in range(workers)], self._memory_gb())
        try:
            yield from packed(pool, tasks)
        finally:
            pool.close()

    def _memory_gb(self) -> float:
        free = available_memory()
        return self.memory_gb or (UNKNOWN_GB if free is None else SHARE * free / 1e9)


class _Processes:
    """Supervisors of this process, each in a thread of its own while it has a task."""

    def __init__(self, supervisors: list[Supervisor], memory_gb: float) -> None:
        self._all = supervisors
        self._idle: queue.SimpleQueue[Supervisor] = queue.SimpleQueue()
        for supervisor in supervisors:
            self._idle.put(supervisor)
        self._place = Place(memory_gb, len(supervisors))
        self._threads = ThreadPoolExecutor(len(supervisors), thread_name_prefix="case")

    def places(self) -> Mapping[str, Place]:
        """Where we are."""
        return {HERE: self._place}

    def start(self, task: Task, place: str) -> Hashable:
        """Hand the task to an idle supervisor."""
        del place
        return self._threads.submit(self._attempt, task)

    def ended(self, running: Mapping[Hashable, Task]) -> Sequence[tuple[Hashable, Outcome]]:
        """Those that have ended within a moment."""
        futures: list[Future[Outcome]] = [handle for handle in running if isinstance(handle, Future)]
        done, _ = wait(futures, timeout=MOMENT_S, return_when=FIRST_COMPLETED)
        return [(future, future.result()) for future in done]

    def _attempt(self, task: Task) -> Outcome:
        supervisor = self._idle.get()
        try:
            return supervisor.attempt(task)
        finally:
            self._idle.put(supervisor)

    def close(self) -> None:
        """End all processes and threads."""
        for supervisor in self._all:
            supervisor.close()
        self._threads.shutdown(wait=True, cancel_futures=True)
