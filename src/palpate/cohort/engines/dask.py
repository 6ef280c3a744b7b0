"""The engine on Dask distributed: a cluster of this machine's own, or any scheduler that runs somewhere."""

from __future__ import annotations

import asyncio
import time
from collections import deque
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import CancelledError
from contextlib import ExitStack
from dataclasses import dataclass
from importlib import import_module
from threading import Lock
from typing import Any, ClassVar

from palpate.cohort.engines.attempts import SHARE, UNKNOWN_GB, Memory, marked, outcome_of
from palpate.cohort.supervise import ESTIMATE, Supervisor
from palpate.cohort.task import Outcome, Task
from palpate.errors import ResourceError
from palpate.parallel import processors

LOOPBACK = "127.0.0.1"
PATIENCE_S = 600.0  # for a first worker, and for another when all are gone
MOMENT_S = 1.0
GATHER_S = 15.0  # for a few lines of JSON from a worker
ADVICE = "--engine dask needs Dask distributed, which is not installed: pip install 'palpate[cluster]'"
GONE = (
    "the Dask scheduler at {} is gone; what is done stays done: start another one, and run the cohort again with"
    " --resume"
)
NOBODY = "there is no worker to compute on; start some, and run the cohort again with --resume"


@dataclass(frozen=True, slots=True)
class DaskEngine:
    """Workers of the Dask scheduler at an address; None: so many processes of this machine, on loopback alone.

    Workers must see the cohort's folder and the images under the same paths. Each of a worker's threads takes one case
    at a time, and all of them share the worker's memory limit. Rows of workers that are gone are Dask's to give to
    others.
    """

    name: ClassVar[str] = "dask"

    scheduler: str | None = None
    workers: int | None = None
    work: str = ESTIMATE

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
                here = {"host": LOOPBACK, "dashboard_address": None, "silence_logs": 50}
                cluster = distributed.LocalCluster(n_workers=count, threads_per_worker=1, **here)
                address = stack.enter_context(cluster)
            try:
                client = stack.enter_context(distributed.Client(address, set_as_default=False))
            except (OSError, ValueError) as error:
                raise ResourceError(f"no Dask scheduler answers at {self.scheduler}: {error}") from error
            try:
                yield from self._outcomes(client, tasks)
            except (OSError, CancelledError, asyncio.CancelledError) as error:  # in the midst of a question to it
                raise ResourceError(GONE.format(self.scheduler or LOOPBACK)) from error

    def _outcomes(self, client: Any, tasks: Sequence[Task]) -> Iterator[Outcome]:
        """Those of tasks that are submitted so many at a time."""
        left = deque[tuple[Task, tuple[str, ...]]]((task, ()) for task in tasks)  # with the workers that have room
        running, seen = dict[Any, Task](), time.monotonic()
        while left or running:
            limits, now = _limits_gb(client), time.monotonic()
            seen = now if limits else seen
            if now > seen + PATIENCE_S:
                raise ResourceError(NOBODY)
            most = max(limits.values(), default=0.0)
            while left and limits and len(running) < (self.workers or len(tasks)):
                task, places = left.popleft()
                given = (task.to_json(), self.work, most)
                preferred: dict[str, Any] = {"workers": places, "allow_other_workers": True} if places else {}
                running[client.submit(outcome_on_worker, *given, pure=False, **preferred)] = task
            while not (done := [f for f in running if f.status != "pending"]) and time.monotonic() < now + MOMENT_S:
                time.sleep(0.02)
            limits = _limits_gb(client)  # where the scheduler is gone, so are its futures
            for future in done:
                task = running[future]
                if (outcome := _outcome(future, task)) is None:
                    continue
                del running[future]
                if outcome.cause == "room":
                    left.appendleft((task, tuple(name for name, gb in limits.items() if gb == max(limits.values()))))
                else:
                    yield outcome


def outcome_on_worker(task: str, work: str, elsewhere_gb: float) -> dict[str, Any]:
    """What a task (JSON) comes to in children of the Dask worker that calls this; as JSON's own types."""
    found = outcome_of(Task.from_json(task), Supervisor(work), _memory_here(), elsewhere_gb=elsewhere_gb)
    return found.to_dict()


_HERE, _MAKING = list[Memory](), Lock()


def _memory_here() -> Memory:
    """The memory of this Dask worker, which its threads share."""
    with _MAKING:
        if not _HERE:
            worker = import_module("distributed").get_worker()
            _HERE.append(Memory(_usable_gb(worker.memory_manager.memory_limit), worker.state.nthreads))
    return _HERE[0]


def _usable_gb(limit: float | None) -> float:
    """What cases may take of a worker's memory limit (bytes; nothing: none)."""
    return SHARE * limit / 1e9 if limit else UNKNOWN_GB


def _limits_gb(client: Any) -> Mapping[str, float]:
    """Memory (GB) of each worker, by its address; raises `OSError` where the scheduler is gone."""
    if client.status != "running":
        raise OSError("the connection is lost")
    try:
        found: Mapping[str, Any] = client.scheduler_info(n_workers=-1)["workers"]
    except TypeError:  # before 2025.4 it names them all
        found = client.scheduler_info()["workers"]
    running = {name: of for name, of in found.items() if of.get("status", "running") == "running"}
    return {name: _usable_gb(of["memory_limit"]) for name, of in running.items()}


def _outcome(future: Any, task: Task) -> Outcome | None:
    """The outcome of a future that has ended; None where it went with its worker: the task is computed again."""
    if future.status == "finished":
        try:
            return Outcome(**future.result(timeout=GATHER_S))
        except TimeoutError:
            return None
    error = future.exception() if future.status == "error" else None
    if error is not None and type(error).__name__ not in ("KilledWorker", "CancelledError"):
        return marked(task, Outcome.failed(task, "crash", f"the worker failed: {type(error).__name__}: {error}"))
    return marked(task, Outcome.failed(task, "lost", "the Dask workers that computed it are gone", cause="lost"))
