"""The engine of this machine: some threads, each of which watches a process at a time."""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from dataclasses import dataclass
from typing import ClassVar

from palpate.cohort.engines.attempts import SHARE, UNKNOWN_GB, Memory, outcome_of
from palpate.cohort.supervise import ESTIMATE, Supervisor
from palpate.cohort.task import Outcome, Task
from palpate.errors import ResourceError
from palpate.memory import available_memory
from palpate.parallel import processors


@dataclass(frozen=True, slots=True)
class LocalEngine:
    """So many workers (None: one a processor) with so much memory (GB, None: what is free), as children of this one.

    work: "module:function" that a task is done with.
    """

    name: ClassVar[str] = "local"

    workers: int | None = None
    memory_gb: float | None = None
    work: str = ESTIMATE

    def outcomes(self, tasks: Sequence[Task]) -> Iterator[Outcome]:
        """The outcome of each task; memory is shared by what is predicted. Raises `ResourceError` on Windows."""
        if not hasattr(os, "fork"):
            raise ResourceError("cohorts need a system that forks processes: Linux or macOS, or a Dask worker on one")
        workers, free = max(min(self.workers or processors(), len(tasks)), 1), available_memory()
        memory = Memory(self.memory_gb or (UNKNOWN_GB if free is None else SHARE * free / 1e9), workers)
        supervisor = Supervisor(self.work)
        with ThreadPoolExecutor(workers, thread_name_prefix="case") as threads:
            futures = [threads.submit(outcome_of, task, supervisor, memory) for task in tasks]
            try:
                for future in as_completed(futures):
                    yield future.result()
            finally:
                supervisor.close()
                threads.shutdown(wait=False, cancel_futures=True)
