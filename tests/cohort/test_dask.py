"""Dask as an engine: rows are submitted so many at a time, what lacks room goes elsewhere, a scheduler ends the run."""

from __future__ import annotations

import contextlib
import sys
import types

import pytest

from palpate.cohort.engines import dask
from palpate.cohort.engines.dask import DaskEngine, outcome_on_worker
from palpate.cohort.task import Limits, Outcome, Row, Task
from palpate.errors import ResourceError


class KilledWorker(Exception):  # noqa: N818 - Dask's name
    """As Dask calls what every worker dies of."""


class Future:
    """A future that ended as the row's name says."""

    def __init__(self, task, workers):
        self.task, self.workers, self.asked = task, workers, 0
        self.status = "error" if task.row.id in ("bad", "deadly") else "finished"

    def result(self, timeout):
        self.asked += 1
        if self.task.row.id == "gathered late" and self.asked == 1:
            raise TimeoutError(timeout)
        if self.task.row.id == "large" and not self.workers:
            return Outcome("large", "failed", cause="room", expected_gb=7.0).to_dict()
        return Outcome(self.task.row.id, "done").to_dict()

    def exception(self):
        return KilledWorker() if self.task.row.id == "deadly" else OSError("no such folder")


class Client:
    """What the engine asks of Dask's client, and how many futures it had at once."""

    def __init__(self, status="running"):
        self.status, self.futures, self.most = status, [], 0
        worker = {"memory_limit": 4e9, "nthreads": 1, "status": "running"}
        self.workers = {"small": worker, "large": {**worker, "memory_limit": 8e9}}

    def scheduler_info(self, n_workers):
        assert n_workers == -1
        return {"workers": dict(self.workers)}

    def submit(self, function, task, work, elsewhere_gb, *, pure, workers=(), allow_other_workers=False):
        assert function is outcome_on_worker
        assert not pure
        assert ":" in work
        assert elsewhere_gb == pytest.approx(7.2)
        assert allow_other_workers == bool(workers)
        self.futures.append(Future(Task.from_json(task), workers))
        self.most = max(self.most, sum(not future.asked for future in self.futures))
        return self.futures[-1]


@pytest.fixture
def outcomes(tmp_path, monkeypatch):
    """The outcomes of rows with these names on a scheduler, by their ids; nobody waits for workers."""
    monkeypatch.setattr(dask, "MOMENT_S", 0.01)
    monkeypatch.setattr(dask, "PATIENCE_S", 0.02)

    def of(client, *names, workers=None):
        distributed = types.SimpleNamespace(Client=lambda *_, **__: contextlib.nullcontext(client))
        monkeypatch.setitem(sys.modules, "distributed", distributed)
        tasks = [Task(Row(name, "P"), str(tmp_path / name), "0" * 64, (), Limits()) for name in names]
        return {found.id: found for found in DaskEngine("tcp://here:1", workers, "a:b").outcomes(tasks)}

    return of


def test_rows_are_submitted_so_many_at_a_time(outcomes):
    client = Client()
    names = [f"r{i}" for i in range(6)]
    found = outcomes(client, *names, workers=2)
    assert sorted(found) == names
    assert {outcome.state for outcome in found.values()} == {"done"}
    assert [future.task.row.id for future in client.futures] == names
    assert client.most == 2


def test_a_case_that_its_worker_has_no_room_for_goes_to_the_largest(outcomes):
    client = Client()
    assert outcomes(client, "large")["large"].state == "done"
    assert [future.workers for future in client.futures] == [(), ("large",)]


def test_an_outcome_that_went_with_its_worker_is_asked_for_again(outcomes):
    client = Client()
    assert outcomes(client, "gathered late")["gathered late"].state == "done"
    assert [future.asked for future in client.futures] == [2]


def test_a_worker_that_fails_is_a_crash_of_its_row(outcomes):
    found = outcomes(Client(), "bad")["bad"]
    assert (found.failure_class, found.message) == ("crash", "the worker failed: OSError: no such folder")


def test_a_row_that_every_worker_dies_of_is_lost(outcomes, tmp_path):
    assert outcomes(Client(), "deadly")["deadly"].failure_class == "lost"
    assert (tmp_path / "deadly/done.json").exists()


def test_a_scheduler_that_is_gone_ends_the_run(outcomes, monkeypatch):
    with pytest.raises(ResourceError, match="--resume"):
        outcomes(Client(status="closed"), "a")
    monkeypatch.setattr(Future, "result", lambda *_, **__: (_ for _ in ()).throw(ConnectionResetError()))
    with pytest.raises(ResourceError, match="tcp://here:1 is gone"):
        outcomes(Client(), "a")


def test_without_workers_rows_wait(outcomes):
    client = Client()
    client.workers.clear()
    with pytest.raises(ResourceError, match="no worker"):
        outcomes(client, "a")


def test_a_cluster_of_this_machine_gives_each_row_its_class(tmp_path):
    does = {"good": "", "killed once": "die 1", "bad": "refuse", "large": "needs 900"}
    rows = [Row(f"r{i}", "P", "1", i, covariates={"does": what}) for i, what in enumerate(does.values())]
    tasks = [Task(row, str(tmp_path / row.id), "0" * 64, (), Limits(0.5, 120.0)) for row in rows]
    found = {outcome.id: outcome for outcome in DaskEngine(None, 2, "cohort_stub:work").outcomes(tasks)}
    classes = [found[row.id].failure_class for row in rows]
    assert classes == ["", "", "geometry", ""]
    assert (tmp_path / "r1/attempt-2").exists()
