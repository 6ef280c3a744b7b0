"""The engine of this machine: some threads, each of which watches a process at a time."""

from __future__ import annotations

import os
from collections.abc import Hashable, Iterator, Mapping, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
from dataclasses import dataclass

from palpate.cohort.engines.packing import Place, packed
from palpate.cohort.supervise import ESTIMATE, Supervisor
from palpate.cohort.task import Outcome, Task
from palpate.errors import ResourceError
from palpate.parallel import processors
from palpate.processes import available_memory

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
        free = available_memory()
        memory_gb = self.memory_gb or (UNKNOWN_GB if free is None else SHARE * free / 1e9)
        pool = _Processes(Supervisor(self.work), Place(memory_gb, workers))
        try:
            yield from packed(pool, tasks)
        finally:
            pool.close()


class _Processes:
    """Processes of this machine, each watched by a thread."""

    def __init__(self, supervisor: Supervisor, place: Place) -> None:
        self._supervisor, self._place = supervisor, place
        self._threads = ThreadPoolExecutor(place.slots, thread_name_prefix="case")

    def places(self) -> Mapping[str, Place]:
        """Where we are."""
        return {HERE: self._place}

    def start(self, task: Task, place: str) -> Hashable:
        """Begin an attempt in a process of its own."""
        del place
        return self._threads.submit(self._supervisor.attempt, task)

    def ended(self, running: Mapping[Hashable, Task]) -> Sequence[tuple[Hashable, Outcome]]:
        """Those that have ended within a moment."""
        futures: list[Future[Outcome]] = [handle for handle in running if isinstance(handle, Future)]
        done, _ = wait(futures, timeout=MOMENT_S, return_when=FIRST_COMPLETED)
        return [(future, future.result()) for future in done]

    def close(self) -> None:
        """End all processes and threads."""
        self._supervisor.close()
        self._threads.shutdown(wait=True, cancel_futures=True)
