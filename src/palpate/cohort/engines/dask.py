"""The engine on Dask distributed: a cluster of this machine's own, or any scheduler that runs somewhere."""

from __future__ import annotations

import asyncio
import time
from collections.abc import Hashable, Iterator, Mapping, Sequence
from concurrent.futures import CancelledError
from contextlib import ExitStack
from dataclasses import dataclass
from importlib import import_module
from typing import Any

from palpate.cohort.engines.local import SHARE, UNKNOWN_GB
from palpate.cohort.engines.packing import Place, packed
from palpate.cohort.supervise import ESTIMATE, Supervisor
from palpate.cohort.task import Outcome, Task
from palpate.errors import ResourceError
from palpate.parallel import processors

LOOPBACK = "127.0.0.1"
MOMENT_S = 1.0
GATHER_S = 15.0  # for a few lines of JSON from a worker
ADVICE = "--engine dask needs Dask distributed, which is not installed: pip install 'palpate[cluster]'"
GONE = (
    "the Dask scheduler at {} is gone; what is done stays done: start another one, and run the cohort again with"
    " --resume"
)


@dataclass(frozen=True, slots=True)
class DaskEngine:
    """Workers of the Dask scheduler at an address; None: so many processes of this machine, on loopback alone.

    Workers must see the cohort's folder and the images under the same paths. Each of a worker's threads takes one case
    at a time, and all of them share the worker's memory limit. patience_s: how long a first worker is waited for, and
    another when all are gone.
    """

    scheduler: str | None = None
    workers: int | None = None
    work: str = ESTIMATE
    patience_s: float = 600.0

    @property
    def name(self) -> str:
        """As `--engine` calls it."""
        return "dask"

    def outcomes(self, tasks: Sequence[Task]) -> Iterator[Outcome]:
        """The outcome of each task; raises `ResourceError` when the scheduler is gone, or Dask is not installed."""
        try:
            distributed = import_module("distributed")
        except ImportError as error:
            raise ResourceError(ADVICE) from error
        if not tasks:
            return
        with ExitStack() as stack:
            address: Any = self.scheduler
            if address is None:
                count = min(self.workers or processors(), len(tasks))
                address = stack.enter_context(
                    distributed.LocalCluster(
                        n_workers=count,
                        threads_per_worker=1,
                        host=LOOPBACK,
                        dashboard_address=None,
                        silence_logs=50,
                    )
                )
            try:
                client = stack.enter_context(distributed.Client(address, set_as_default=False))
            except (OSError, ValueError) as error:
                raise ResourceError(f"no Dask scheduler answers at {self.scheduler}: {error}") from error
            try:
                yield from packed(_Cluster(client, self), tasks)
            except (OSError, CancelledError, asyncio.CancelledError) as error:  # in the midst of a question to it
                raise ResourceError(GONE.format(self.scheduler or LOOPBACK)) from error


def attempt_on_worker(task: str, work: str) -> dict[str, Any]:
    """One attempt of a task (JSON) in a child of the Dask worker that calls this; the outcome as JSON's own types."""
    return Supervisor(work).attempt(Task.from_json(task)).to_dict()


class _Cluster:
    """The workers of a scheduler as places."""

    def __init__(self, client: Any, engine: DaskEngine) -> None:
        self._client, self._engine = client, engine
        self._where: dict[Hashable, str] = {}

    def places(self) -> Mapping[str, Place]:
        """The workers that there are, by their addresses; waits for the first. Raises `OSError` without scheduler."""
        end = time.monotonic() + self._engine.patience_s
        while not (workers := self._workers()) and time.monotonic() < end:
            time.sleep(MOMENT_S)
        found = {}
        for address, worker in list(workers.items())[: self._engine.workers]:
            limit = float(worker["memory_limit"] or 0.0)
            found[address] = Place(SHARE * limit / 1e9 if limit else UNKNOWN_GB, int(worker["nthreads"]))
        return found

    def _workers(self) -> Mapping[str, Any]:
        if self._client.status != "running":
            raise OSError("the connection is lost")
        try:
            found: Mapping[str, Any] = self._client.scheduler_info(n_workers=-1)["workers"]
        except TypeError:  # before 2025.4 it names them all
            found = self._client.scheduler_info()["workers"]
        return {address: worker for address, worker in found.items() if worker.get("status", "running") == "running"}

    def start(self, task: Task, place: str) -> Hashable:
        """Submit an attempt to that worker, and to no other."""
        future: Hashable = self._client.submit(
            attempt_on_worker, task.to_json(), self._engine.work, workers=[place], allow_other_workers=False, pure=False
        )
        self._where[future] = place
        return future

    def ended(self, running: Mapping[Hashable, Task]) -> Sequence[tuple[Hashable, Outcome]]:
        """Those that have ended, or whose worker is gone."""
        end = time.monotonic() + MOMENT_S
        futures: list[Any] = list(running)
        while not (done := [future for future in futures if future.status != "pending"]) and time.monotonic() < end:
            time.sleep(0.02)
        workers = self._workers()
        found = [(future, self._outcome(future, running[future])) for future in done]
        for future in futures:
            if future not in done and self._where[future] not in workers:
                future.cancel()
                found.append((future, _lost(running[future])))
        for future, _ in found:
            del self._where[future]
        return found

    def _outcome(self, future: Any, task: Task) -> Outcome:
        if future.status == "finished":
            try:
                return Outcome(**future.result(timeout=GATHER_S))
            except TimeoutError:  # its worker is gone with it, and nobody else may compute it; its mark is on the disk
                future.cancel()
                return _lost(task)
        if future.status == "error":
            error = future.exception()
            if type(error).__name__ not in ("KilledWorker", "CancelledError"):
                return Outcome.failed(task, "crash", f"the worker failed: {type(error).__name__}: {error}")
        return _lost(task)


def _lost(task: Task) -> Outcome:
    return Outcome.failed(task, "lost", "the Dask worker that computed it is gone", cause="lost")
