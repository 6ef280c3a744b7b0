"""Whoever computes: every row has an outcome of its own class, nothing is computed twice, nothing is lost."""

from __future__ import annotations

import dataclasses
import json
import os
import signal
import subprocess
import sys
import time
from functools import partial
from importlib import import_module
from pathlib import Path

import pytest

from case_texts import ORGAN, case_text
from palpate.cohort.cluster import outcomes
from palpate.cohort.plan import read_mark
from palpate.cohort.progress import status_of
from palpate.cohort.resolve import row_key
from palpate.cohort.row import RowLostError, estimate_row
from palpate.cohort.run import Options, run_cohort
from palpate.cohort.task import Limits, Row, Task
from palpate.errors import ConfigurationError, ResourceError
from palpate.progress import silent

STUB = (str(Path(__file__).with_name("stub.py")),)
TEMPLATE = case_text({"prostate": ORGAN, "rectum": {"label": 2, "role": "driver"}}, before=None, after=None)


@pytest.fixture
def rows_that(tmp_path):
    """Rows whose ids tell the stub what to do."""
    template = tmp_path / "template.toml"
    template.write_text(TEMPLATE)

    def rows(*ids):
        return [
            Row(name, f"P{number}", "1", number % 3, before="b.nii.gz", after=("a.nii.gz",), template=str(template))
            for number, name in enumerate(ids)
        ]

    return rows


def task_of(row, folder, **limits):
    limits = {"memory_gb": 0.5, "seconds": 120.0} | limits
    return Task(row, str(folder / "cases" / row.id), row_key(row), (), Limits(**limits), STUB)


def in_turn(tasks):
    """Each task once, in this process, by the stub."""
    for task in tasks:
        yield estimate_row(dataclasses.replace(task, program=STUB))


def on_workers(tasks):
    """The same on workers of Dask."""
    stubbed = [dataclasses.replace(task, program=STUB) for task in tasks]
    return outcomes(stubbed, scheduler=None, workers=2)


def ends(pid):
    deadline = time.monotonic() + 60.0
    while Path(f"/proc/{pid}").exists() and "Z" not in Path(f"/proc/{pid}/stat").read_text().split()[2]:
        assert time.monotonic() < deadline
        time.sleep(0.05)


def run(folder, rows, *, compute=in_turn, **options):
    folder.mkdir(exist_ok=True)
    said = []
    limits = Limits(memory_gb=0.5, seconds=120.0)
    records = run_cohort(rows, folder, compute, Options(limits=limits, **options), progress=said.append)
    return {record.row.id: record for record in records}, said


@pytest.mark.parametrize(
    ("does", "failure_class", "message"),
    [
        ("good", "", ""),
        ("exit-1", "crash", "an organ is too thin"),
        ("exit-2", "usage", "an organ is too thin"),
        ("exit-3", "input", "an organ is too thin"),
        ("exit-4", "geometry", "an organ is too thin"),
        ("exit-5", "solver", "an organ is too thin"),
        ("exit-6", "resources", "an organ is too thin"),
        ("abort", "crash", "SIGABRT"),
        ("fill", "resources", "more than the 0.5 GB of memory"),
        ("swell", "resources", "the system ended it at 0.6 GB"),
    ],
)
def test_what_a_row_comes_to_is_told_by_its_process(rows_that, tmp_path, does, failure_class, message):
    (row,) = rows_that(does)
    task = task_of(row, tmp_path, memory_gb=1.0 if does == "swell" else 0.5)
    outcome = estimate_row(task)
    assert (outcome.state, outcome.failure_class) == ("failed" if failure_class else "done", failure_class)
    assert message in outcome.message
    assert "warning" not in outcome.message
    assert read_mark(Path(task.folder)) == outcome
    assert estimate_row(task) == outcome  # it is not computed again
    assert len(list(Path(task.folder).glob("attempt-*"))) == 1


def test_a_row_that_hangs_is_ended(rows_that, tmp_path):
    outcome = estimate_row(task_of(*rows_that("hang"), tmp_path, seconds=0.5))
    assert outcome.failure_class == "timeout"
    assert "more than the 0.5 s" in outcome.message


def test_a_row_that_something_else_ends_has_no_mark(rows_that, tmp_path):
    (row,) = rows_that("die-9")
    with pytest.raises(RowLostError, match="SIGKILL"):
        estimate_row(task_of(row, tmp_path))
    assert not (tmp_path / "cases/die-9/done.json").exists()


def test_a_row_that_cannot_be_meant_starts_no_process(rows_that, tmp_path):
    row = dataclasses.replace(rows_that("good")[0], problem="its stage is 'T2'")
    outcome = estimate_row(task_of(row, tmp_path))
    assert (outcome.failure_class, outcome.message) == ("usage", "its stage is 'T2'")
    assert not (tmp_path / "cases/good/attempt-1").exists()


def test_an_input_that_is_changed_meanwhile_is_a_failure_of_its_row(rows_that, tmp_path):
    task = dataclasses.replace(task_of(*rows_that("good"), tmp_path), key="0" * 64)
    assert "was changed while it was used" in estimate_row(task).message


def test_on_workers_of_dask_every_row_has_its_outcome(rows_that, tmp_path):
    """Rows whose process or worker dies are tried again, and lost in the end."""
    rows = rows_that("good", "exit-4", "abort", "die-1", "die-9", "worker-1")
    found, said = run(tmp_path, rows, compute=on_workers)
    classes = {name: record.failure_class for name, record in found.items()}
    assert classes == {
        "good": "",
        "exit-4": "geometry",
        "abort": "crash",
        "die-1": "",
        "die-9": "lost",
        "worker-1": "",
    }
    assert "SIGKILL" in found["die-9"].message
    assert len(list((tmp_path / "cases/die-9").glob("attempt-*"))) == 3
    status = status_of(tmp_path)
    assert (status.done, status.failed) == (3, {"geometry": 1, "crash": 1, "lost": 1})
    assert any("to go of 6" in text for text in said)
    ends((tmp_path / "cases/worker-1/attempt-1").read_text())  # with its worker


def test_a_row_whose_workers_die_is_lost(rows_that, tmp_path):
    with import_module("dask").config.set({"distributed.scheduler.allowed-failures": 0}):
        found, _ = run(tmp_path, rows_that("worker-9"), compute=on_workers)
    assert (found["worker-9"].failure_class, found["worker-9"].message[-8:]) == ("lost", "has died")


def test_what_is_done_is_not_computed_again_and_what_changed_is(rows_that, tmp_path):
    rows = rows_that("good-0", "good-1", "exit-4")
    (tmp_path / "c.nii.gz").write_text("another image")
    run(tmp_path, rows)
    with pytest.raises(ConfigurationError, match="--resume goes on"):
        run(tmp_path, rows)
    changed = [dataclasses.replace(rows[0], after=(str(tmp_path / "c.nii.gz"),)), *rows[1:]]
    run(tmp_path, changed, resume=True)
    attempts = {row.id: len(list((tmp_path / "cases" / row.id).glob("attempt-*"))) for row in rows}
    assert attempts == {"good-0": 2, "good-1": 1, "exit-4": 1}
    staged = [dataclasses.replace(row, stage=7, session="9") for row in changed]  # no estimate depends on these
    marks = [read_mark(tmp_path / "cases" / row.id) for row in rows]
    found, said = run(tmp_path, staged, resume=True)
    assert [read_mark(tmp_path / "cases" / row.id) for row in rows] == marks
    assert found["good-1"].row.stage == 7
    assert any("0 to compute" in text for text in said)
    _, said = run(tmp_path, staged, only_failed=True)
    assert any("1 to compute" in text for text in said)
    _, said = run(tmp_path, staged, overwrite=True)
    assert not any("to compute" in text for text in said)


def test_a_result_that_was_changed_since_is_waiting(rows_that, tmp_path):
    rows = rows_that("good-0", "good-1")
    run(tmp_path, rows)
    path = tmp_path / "cases/good-0/result.json"
    path.write_text(path.read_text().replace("30.0", "31.0"))
    found, _ = run(tmp_path, rows, only_failed=True)
    assert [record.state for record in found.values()] == ["waiting", "done"]
    found, _ = run(tmp_path, rows, resume=True)
    assert [record.state for record in found.values()] == ["done", "done"]


def test_shards_share_a_folder_and_the_last_one_writes_the_tables(rows_that, tmp_path):
    rows = rows_that("good-0", "good-1", "exit-4", "good-3", "good-4")
    found, said = run(tmp_path, rows, shard=(2, 2))
    assert [record.state for record in found.values()] == ["waiting", "done", "waiting", "done", "waiting"]
    assert any("0 to go of 2" in text for text in said)
    assert not (tmp_path / "cohort.csv").exists()
    found, _ = run(tmp_path, rows, shard=(1, 2))
    assert [record.state for record in found.values()] == ["done", "done", "failed", "done", "done"]
    assert (tmp_path / "cohort.csv").exists()
    run(tmp_path, rows, shard=(1, 2), only_failed=True)
    attempts = {row.id: len(list((tmp_path / "cases" / row.id).glob("attempt-*"))) for row in rows}
    assert attempts == {"good-0": 1, "good-1": 1, "exit-4": 2, "good-3": 1, "good-4": 1}


def test_workers_that_are_gone_leave_tables_of_what_is_done(rows_that, tmp_path):
    def dies(tasks):
        yield from in_turn(tasks[:1])
        raise ResourceError("the scheduler is gone")

    rows = rows_that("good-0", "good-1", "good-2")
    with pytest.raises(ResourceError, match="gone"):
        run(tmp_path, rows, compute=dies)
    table = (tmp_path / "cohort.csv").read_text().splitlines()
    assert [line.split(",")[4] for line in table[1:]] == ["done", "waiting", "waiting"]
    assert json.loads((tmp_path / "plan.json").read_text())["schema"] == "palpate.plan/1"
    assert not [path for path in tmp_path.iterdir() if path.name.startswith(".")]
    found, _ = run(tmp_path, rows, resume=True)
    assert {record.state for record in found.values()} == {"done"}


def test_another_cohort_in_the_folder_is_refused_and_its_own_goes_on(tmp_path):
    def nothing(_):
        return iter(())

    ours, others = ([Row(f"{name}{i}", f"{name}{i}", problem="no image") for i in range(2)] for name in "pq")
    compute = partial(run_cohort, folder=tmp_path, compute=nothing, progress=silent)
    compute(ours, options=Options())
    for rows, options, said in (
        (ours, Options(), "has a cohort already: --resume goes on with it"),
        (others, Options(resume=True), r"has another cohort: none of its 2 rows \('p0' ...\) is in this table"),
    ):
        with pytest.raises(ConfigurationError, match=said):
            compute(rows, options=options)
    compute(ours[:1], options=Options(resume=True))
    records = compute(others, options=Options(overwrite=True))
    assert [record.row.id for record in records] == ["q0", "q1"]


CLIENT = """
import sys
from palpate.cohort.cluster import outcomes
from palpate.cohort.task import Limits, Row, Task
row = Row("hang", "P", before="b", after=("a",), template=sys.argv[2])
task = Task(row, sys.argv[1], "0" * 64, (), Limits(), (sys.argv[3],))
if __name__ == "__main__":
    list(outcomes([task], scheduler=sys.argv[4] or None, workers=1))
"""


def start_client(folder, address):
    script = folder / "client.py"
    script.write_text(CLIENT)
    arguments = [str(folder / "hang"), str(folder / "template.toml"), *STUB, address]
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(place for place in sys.path if place)}
    client = subprocess.Popen([sys.executable, str(script), *arguments], env=environment)
    started = folder / "hang/attempt-1"
    while not (started.exists() and started.read_text()):
        assert client.poll() is None
        time.sleep(0.05)
    return client, int(started.read_text())


@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGINT])
def test_what_a_run_has_started_ends_with_it(rows_that, tmp_path, number):
    rows_that()
    client, row = start_client(tmp_path, "")
    client.send_signal(number)
    client.wait(60.0)
    ends(row)
    assert not (tmp_path / "hang/done.json").exists()


def test_rows_on_another_cluster_end_with_the_run_and_a_run_with_its_scheduler(rows_that, tmp_path):
    rows_that()
    options = {"n_workers": 1, "threads_per_worker": 1, "host": "127.0.0.1", "dashboard_address": None}
    options["scheduler_kwargs"] = {"dashboard_address": "127.0.0.1:0"}
    with import_module("distributed").LocalCluster(**options, silence_logs=50) as cluster:
        client, row = start_client(tmp_path, cluster.scheduler_address)
        client.kill()
        client.wait(60.0)
        ends(row)
        (tmp_path / "hang/attempt-1").unlink()
        client, row = start_client(tmp_path, cluster.scheduler_address)
    assert client.wait(120.0) == 1
    ends(row)


def test_no_scheduler_is_an_error_of_resources(rows_that, tmp_path):
    task = task_of(*rows_that("good"), tmp_path)
    with pytest.raises(ResourceError, match="no Dask scheduler answers at nowhere"):
        list(outcomes([task], scheduler="nowhere://here", workers=1))
    assert list(outcomes([], scheduler="nowhere://here", workers=1)) == []
