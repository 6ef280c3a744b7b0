"""Whoever computes: every row has an outcome of its own class, nothing is computed twice, nothing is lost."""

from __future__ import annotations

import dataclasses
import json
import os
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest

from palpate.cohort.engines.local import LocalEngine
from palpate.cohort.engines.packing import Place, packed
from palpate.cohort.plan import read_mark
from palpate.cohort.progress import status_of
from palpate.cohort.run import Options, run_cohort
from palpate.cohort.supervise import Supervisor
from palpate.cohort.task import FAILURE_CLASSES, Limits, Outcome, Row, Task, failure_class_of
from palpate.errors import (
    ConfigurationError,
    InputDataError,
    MeshQualityError,
    NotConverged,
    PalpateError,
    ResourceError,
)

STUB = "cohort_stub:work"


def rows_that(*does):
    return [
        Row(f"r{number}", f"P{number}", "1", number % 3, problem="a stub", covariates={"does": what})
        for number, what in enumerate(does)
    ]


def run(folder, rows, *, engine=None, seconds=60.0, **options):
    folder.mkdir(exist_ok=True)
    limits = Limits(memory_gb=0.5, seconds=seconds)
    said = []
    engine = engine or LocalEngine(2, 8.0, STUB)
    records = run_cohort(rows, folder, engine, Options(limits=limits, **options), progress=said.append)
    return {record.row.id: record for record in records}, said


def test_each_bad_row_is_one_failed_row_with_its_class(tmp_path):
    rows = rows_that("", "abort", "refuse", "fill 0.7", "die 1", "die 9", "allocate")
    found, said = run(tmp_path, rows)
    classes = {row.covariates["does"]: found[row.id].failure_class for row in rows}
    assert classes == {
        "": "",
        "abort": "crash",
        "refuse": "geometry",
        "fill 0.7": "",
        "die 1": "",
        "die 9": "lost",
        "allocate": "",
    }
    assert "SIGABRT" in found["r1"].message
    assert "0.5 GB" in found["r3"].message
    assert "1.3 times as coarse" in found["r3"].message
    attempts = {row.id: len(list((tmp_path / "cases" / row.id).glob("attempt-*"))) for row in rows}
    assert attempts == {"r0": 1, "r1": 1, "r2": 1, "r3": 2, "r4": 2, "r5": 3, "r6": 2}
    status = status_of(tmp_path)
    assert (status.done, status.running, status.waiting) == (4, 0, 0)
    assert status.failed == {"crash": 1, "geometry": 1, "lost": 1}
    assert any("to go of 7" in text for text in said)


def test_a_row_that_hangs_is_ended_and_not_tried_again(tmp_path):
    found, _ = run(tmp_path, rows_that("hang"), seconds=0.5)
    assert found["r0"].failure_class == "timeout"
    assert "more than the 0.5 s" in found["r0"].message
    assert not (tmp_path / "cases/r0/attempt-2").exists()


def test_what_is_done_is_not_computed_again_and_what_changed_is(tmp_path):
    rows = rows_that("", "", "refuse")
    run(tmp_path, rows)
    with pytest.raises(ConfigurationError, match="--resume goes on"):
        run(tmp_path, rows)
    stamps = {row.id: (tmp_path / "cases" / row.id / "result.json").stat().st_mtime_ns for row in rows[:2]}
    changed = [dataclasses.replace(rows[0], problem="another"), *rows[1:]]
    found, _ = run(tmp_path, changed, resume=True)
    assert (tmp_path / "cases/r0/result.json").stat().st_mtime_ns > stamps["r0"]
    assert (tmp_path / "cases/r1/result.json").stat().st_mtime_ns == stamps["r1"]
    staged = [dataclasses.replace(row, stage=7, session="9") for row in changed]  # no estimate depends on these
    marks = [read_mark(tmp_path / "cases" / row.id) for row in rows]
    found, said = run(tmp_path, staged, resume=True)
    assert [read_mark(tmp_path / "cases" / row.id) for row in rows] == marks
    assert found["r1"].row.stage == 7
    assert any("0 to compute" in text for text in said)
    _, said = run(tmp_path, staged, only_failed=True)
    assert any("1 to compute" in text for text in said)


def test_a_result_that_was_changed_since_is_waiting(tmp_path):
    run(tmp_path, rows_that("", ""))
    path = tmp_path / "cases/r0/result.json"
    path.write_text(path.read_text().replace("30.0", "31.0"))
    found, _ = run(tmp_path, rows_that("", ""), only_failed=True)
    assert [found[row].state for row in ("r0", "r1")] == ["waiting", "done"]
    found, _ = run(tmp_path, rows_that("", ""), resume=True)
    assert [found[row].state for row in ("r0", "r1")] == ["done", "done"]


def task(folder, does="", **changes):
    row = rows_that(does)[0]
    return Task(row, str(folder / "cases" / row.id), "0" * 64, (), Limits(0.5, 3.0), **changes)


ATTEMPT = """
import sys
from palpate.cohort.supervise import Supervisor
from palpate.cohort.task import Task
Supervisor(sys.argv[1]).attempt(Task.from_json(sys.argv[2]))
"""


def test_a_child_dies_with_whoever_started_it(tmp_path):
    places = os.pathsep.join(place for place in sys.path if place)
    command = [sys.executable, "-c", ATTEMPT, STUB, task(tmp_path, "hang").to_json()]
    parent = subprocess.Popen(command, env=os.environ | {"PYTHONPATH": places})
    started = tmp_path / "cases/r0/attempt-1"
    while not started.exists():
        assert parent.poll() is None
        time.sleep(0.02)
    (child,) = Path(f"/proc/{parent.pid}/task/{parent.pid}/children").read_text().split()
    parent.kill()
    parent.wait()
    deadline = time.monotonic() + 30.0
    while Path(f"/proc/{child}").exists() and "Z" not in Path(f"/proc/{child}/stat").read_text().split()[2]:
        assert time.monotonic() < deadline
        time.sleep(0.02)


def test_who_closes_a_supervisor_ends_its_attempts(tmp_path):
    supervisor, found = Supervisor(STUB), []
    thread = threading.Thread(target=lambda: found.append(supervisor.attempt(task(tmp_path, "hang"))))
    thread.start()
    while not (tmp_path / "cases/r0/attempt-1").exists():
        time.sleep(0.02)
    supervisor.close()
    thread.join()
    assert (found[0].failure_class, found[0].cause) == ("lost", "lost")
    assert supervisor.attempt(task(tmp_path)).failure_class == "lost"


@pytest.mark.parametrize(
    ("error", "name"),
    [
        (ConfigurationError(), "usage"),
        (InputDataError(), "input"),
        (MeshQualityError(), "geometry"),
        (NotConverged(), "solver"),
        (ResourceError(), "resources"),
        (MemoryError(), "resources"),
        (ZeroDivisionError(), "crash"),
        (PalpateError(), "crash"),
    ],
)
def test_the_class_of_a_failure_is_that_of_its_exit_code(error, name):
    assert failure_class_of(error) == name
    assert name in FAILURE_CLASSES


@pytest.mark.parametrize(("does", "cause"), [("die 9", "lost"), ("swell 0.8", "memory")])
def test_a_child_that_is_killed_is_taken_for_too_large_beyond_half_of_its_limit(tmp_path, does, cause):
    patient = dataclasses.replace(task(tmp_path, does), limits=Limits(0.5, 120.0))
    assert Supervisor(STUB).attempt(patient).cause == cause


def test_tasks_are_json(tmp_path):
    one = task(tmp_path, "needs 3", expected_gb=1.0 / 3.0, remarks=("a", "b"))
    assert Task.from_json(one.to_json()) == one


class Places:
    """A pool that ends the oldest attempt each time it is asked, and keeps what ran side by side."""

    def __init__(self, places, needs):
        self.needs, self._places, self.reserved, self.most = needs, places, {}, {}

    def places(self):
        return self._places

    def start(self, task, place):
        handle = (task.row.id, task.expected_gb)
        needed = self.needs[task.row.id]
        too_big = task.room_gb is not None and needed > task.room_gb
        self.reserved[handle] = (place, 0.0 if too_big else needed, too_big)
        used = sum(gb for where, gb, _ in self.reserved.values() if where == place)
        self.most[place] = max(self.most.get(place, 0.0), used)
        return handle

    def ended(self, running):
        handle = next(iter(running))
        _, needed, too_big = self.reserved.pop(handle)
        state = ("failed", "room") if too_big else ("done", "")
        return [(handle, Outcome(handle[0], state[0], cause=state[1], expected_gb=needed or self.needs[handle[0]]))]


def test_what_runs_side_by_side_fits_into_memory():
    needs = {f"r{i}": gb for i, gb in enumerate([1.0, 6.0, 6.0, 2.0, 9.0, 1.0, 3.0, 30.0])}
    tasks = [Task(Row(name, "P"), "nowhere") for name in needs]
    pool = Places({"small": Place(4.0, 2), "large": Place(12.0, 3)}, needs)
    assert sorted(outcome.id for outcome in packed(pool, tasks)) == sorted(needs)
    assert pool.most["small"] <= 4.0
    assert pool.most["large"] == 30.0  # larger than any place: alone on the largest
    del needs["r7"]
    pool = Places({"small": Place(4.0, 2), "large": Place(12.0, 3)}, needs)
    list(packed(pool, tasks[:-1]))
    assert pool.most["large"] <= 12.0


def test_a_pool_without_places_leaves_its_tasks_waiting():
    with pytest.raises(ResourceError, match="no worker"):
        list(packed(Places({}, {}), [Task(Row("a", "P"), "nowhere")]))


def test_an_engine_that_dies_leaves_tables_of_what_is_done(tmp_path):
    class Dies:
        name = "local"

        def outcomes(self, tasks):
            yield from LocalEngine(1, 8.0, STUB).outcomes(tasks[:1])
            raise ResourceError("the scheduler is gone")

    with pytest.raises(ResourceError, match="gone"):
        run(tmp_path, rows_that("", "", ""), engine=Dies())
    table = (tmp_path / "cohort.csv").read_text().splitlines()
    assert [line.split(",")[4] for line in table[1:]] == ["done", "waiting", "waiting"]
    assert json.loads((tmp_path / "plan.json").read_text())["schema"] == "palpate.plan/1"
    found, _ = run(tmp_path, rows_that("", "", ""), resume=True)
    assert {record.state for record in found.values()} == {"done"}
