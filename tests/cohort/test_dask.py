"""Dask as an engine: rows stay with their worker, a worker that is gone is a lost attempt, a scheduler ends the run."""

from __future__ import annotations

from contextlib import nullcontext
from types import SimpleNamespace

import pytest

from palpate.cohort.engines.dask import DaskEngine, attempt_on_worker
from palpate.cohort.task import Limits, Outcome, Row, Task
from palpate.errors import ResourceError


class Future:
    """A future that is pending until the client says otherwise."""

    def __init__(self, task, worker):
        self.task, self.worker, self.status, self.cancelled = task, worker, "pending", False

    def result(self, timeout):
        if self.task.row.id == "gathered late" and self.task.attempt == 1:
            raise TimeoutError(timeout)
        if self.task.row.id == "cut off":
            raise ConnectionResetError
        return Outcome(self.task.row.id, "done", attempts=self.task.attempt).to_dict()

    def exception(self):
        return OSError("no such folder")

    def cancel(self):
        self.cancelled = True


class Client:
    """What the engine asks of Dask's client: workers that die when they get their first row, and one that lives."""

    scheduler = None

    def __init__(self, mortal, status="running"):
        self.status, self.futures = status, []
        worker = {"memory_limit": 4e9, "nthreads": 1, "status": "running"}
        self.workers = {**{f"mortal-{i}": worker for i in range(mortal)}, "immortal": {**worker, "nthreads": 2}}

    def scheduler_info(self, n_workers):
        assert n_workers == -1
        return {"workers": dict(self.workers)}

    def submit(self, function, task, work, *, workers, allow_other_workers, pure):
        assert function is attempt_on_worker
        assert not allow_other_workers
        assert not pure
        assert ":" in work
        future = Future(Task.from_json(task), workers[0])
        self.futures.append(future)
        if workers[0] == "immortal":
            future.status = "error" if future.task.row.id == "bad" else "finished"
        else:
            del self.workers[workers[0]]
        return future


@pytest.fixture
def outcomes(put_library):
    """The outcomes of tasks on the workers of a client, by a scheduler whose address is never asked."""

    def of(client, tasks, **options):
        put_library("distributed", SimpleNamespace(Client=lambda *_, **__: nullcontext(client)))
        return list(DaskEngine("tcp://here:1", work="a:b", **options).outcomes(tasks))

    return of


def tasks(folder, *names):
    return [Task(Row(name, "P"), str(folder / name), "0" * 64, (), Limits()) for name in names]


def test_rows_of_workers_that_are_gone_go_to_others(tmp_path, outcomes):
    client = Client(mortal=2)
    names = [f"r{i}" for i in range(6)]
    found = {o.id: o for o in outcomes(client, tasks(tmp_path, *names))}
    assert {outcome.state for outcome in found.values()} == {"done"}
    assert sorted(found) == names
    assert sorted(outcome.attempts for outcome in found.values()) == [1, 1, 1, 1, 2, 2]
    assert all(future.cancelled == (future.worker != "immortal") for future in client.futures)


def test_an_outcome_that_went_with_its_worker_is_asked_for_again(tmp_path, outcomes):
    client = Client(mortal=0)
    (found,) = outcomes(client, tasks(tmp_path, "gathered late"))
    assert (found.state, found.attempts) == ("done", 2)
    assert client.futures[0].cancelled


def test_a_worker_that_fails_is_a_crash_of_its_row(tmp_path, outcomes):
    (found,) = outcomes(Client(mortal=0), tasks(tmp_path, "bad"))
    assert (found.failure_class, found.message) == ("crash", "the worker failed: OSError: no such folder")


def test_a_row_that_every_worker_dies_of_is_lost(tmp_path, outcomes):
    client = Client(mortal=4)
    del client.workers["immortal"]
    (found,) = outcomes(client, tasks(tmp_path, "heavy"))
    assert (found.failure_class, found.attempts) == ("lost", 3)
    assert (tmp_path / "heavy/done.json").exists()


def test_a_scheduler_that_is_gone_ends_the_run(tmp_path, outcomes):
    with pytest.raises(ResourceError, match="--resume"):
        outcomes(Client(mortal=0, status="closed"), tasks(tmp_path, "a"))
    with pytest.raises(ResourceError, match="tcp://here:1 is gone"):
        outcomes(Client(mortal=0), tasks(tmp_path, "cut off"))


def test_without_workers_rows_wait(tmp_path, outcomes):
    client = Client(mortal=0)
    client.workers.clear()
    with pytest.raises(ResourceError, match="no worker"):
        outcomes(client, tasks(tmp_path, "a"), patience_s=0.02)
