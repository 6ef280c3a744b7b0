"""The workers of a cohort: a Dask cluster of this machine, or any other whose scheduler has an address."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import ExitStack
from importlib import import_module
from pathlib import Path
from typing import Any

from palpate.cohort.plan import read_mark, write_mark
from palpate.cohort.row import RowLostError, estimate_row
from palpate.cohort.task import Outcome, Task
from palpate.errors import ResourceError
from palpate.processes import total_memory
from palpate.study.outputs import make_folder

LOOPBACK = "127.0.0.1"
RETRIES = 2  # of a row whose process was ended from outside; one whose worker dies has Dask's `allowed-failures`
PATIENCE_S = 600.0  # for the first worker of somebody's own cluster
QUIET = 50  # level of what Dask logs: what matters is an outcome
GONE = (
    "the Dask scheduler at {} is gone; what is done stays done: start another one, and run the cohort again with"
    " --resume"
)


def outcomes(tasks: Sequence[Task], *, scheduler: str | None, workers: int) -> Iterator[Outcome]:
    """The outcome of each task, in the order in which they end; its mark is written by then.

    scheduler: address of a cluster whose workers see the same files under the same paths; None: so many workers of this
    machine, on loopback alone, which share its memory. Whoever stops asking ends what still runs. Raises
    `ResourceError` when there are no workers, or the scheduler is gone: the rows without an outcome are then waiting.
    """
    if not tasks:
        return
    distributed = import_module("distributed")
    with ExitStack() as stack:
        address: Any = scheduler
        if scheduler is None:
            address = stack.enter_context(_local_cluster(distributed, workers))
        try:
            client = stack.enter_context(distributed.Client(address))
            client.wait_for_workers(1, timeout=PATIENCE_S)
        except TimeoutError as error:
            raise ResourceError(
                f"no Dask scheduler with a worker answers at {scheduler}: start them, then run the cohort again with"
                " --resume"
            ) from error
        except (OSError, ValueError) as error:
            raise ResourceError(f"no Dask scheduler answers at {scheduler}: {error}") from error
        futures = dict(zip(client.map(estimate_row, tasks, pure=False, retries=RETRIES), tasks, strict=True))
        for future in distributed.as_completed(list(futures)):
            task = futures.pop(future)
            if future.status == "finished":
                yield future.result()
            elif future.status == "error":
                yield _ended_without(task, future.exception())
            else:
                raise ResourceError(GONE.format(scheduler or LOOPBACK))


def _local_cluster(distributed: Any, workers: int) -> Any:
    """A cluster of this machine; a nanny starts each worker again that dies."""
    memory = total_memory()
    try:
        return distributed.LocalCluster(
            n_workers=workers,
            threads_per_worker=1,
            memory_limit="auto" if memory is None else int(memory / workers),
            host=LOOPBACK,
            dashboard_address=None,  # no dashboard; what tells of the scheduler's health takes any free port
            scheduler_kwargs={"dashboard_address": f"{LOOPBACK}:0"},
            silence_logs=QUIET,
        )
    except (OSError, RuntimeError) as error:
        raise ResourceError(
            f"the workers could not be started ({error}): is memory left, and a process for this user?"
        ) from error


def _ended_without(task: Task, error: BaseException) -> Outcome:
    """The outcome of a row whose task has ended with an error, and its mark."""
    folder = make_folder(Path(task.folder))
    mark = read_mark(folder)
    if mark is not None and mark.key == task.key:  # its worker died after that
        return mark
    if isinstance(error, RowLostError):
        outcome = Outcome.failed(task, "lost", str(error))
    elif type(error).__name__ == "KilledWorker":
        outcome = Outcome.failed(task, "lost", "each Dask worker that computed it has died")
    else:
        outcome = Outcome.failed(task, "crash", f"the worker failed: {type(error).__name__}: {error}")
    return write_mark(folder, outcome)
