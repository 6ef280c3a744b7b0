"""The commands of cohorts: what is refused before anything is computed, and a run that is interrupted."""

from __future__ import annotations

import csv
import os
import signal
import subprocess
import sys
import time

import pytest

from palpate.cli import main
from palpate.cohort.row import estimate_row
from palpate.study.lock import folder_lock

TABLE = "id,patient,stage,before,after\nr0,P,1,b.nii.gz,a.nii.gz\nr1,Q,x,b.nii.gz,a.nii.gz\n"


@pytest.fixture
def table(tmp_path):
    (tmp_path / "cohort.csv").write_text(TABLE)
    return tmp_path / "cohort.csv"


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["TABLE", "--template", "nowhere.toml"], "there is no template"),
        (["TABLE", "--scheduler", "tcp://here:1", "--workers", "2"], "--workers goes without --scheduler"),
        (["TABLE", "--reference", "1"], "--reference goes with BIDS"),
        (["nowhere.csv"], "cannot read the table"),
    ],
)
def test_a_command_that_cannot_be_meant_is_refused(table, tmp_path, capsys, arguments, said):
    given = [str(table) if word == "TABLE" else word for word in arguments]
    assert main(["cohort", *given, "--output", str(tmp_path / "out")]) == 2
    assert said in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("shard", ["0/2", "3/2", "1", "1/x"])
def test_a_shard_that_there_is_not_is_refused(table, capsys, shard):
    with pytest.raises(SystemExit, match="2"):
        main(["cohort", str(table), "--shard", shard])
    assert "is no shard: write K/N" in capsys.readouterr().err


def test_two_runs_in_one_folder_are_refused(table, tmp_path, capsys):
    (tmp_path / "out").mkdir()
    with folder_lock(tmp_path / "out"):
        assert main(["cohort", str(table), "--output", str(tmp_path / "out")]) == 6
    assert "another run of palpate" in capsys.readouterr().err


@pytest.mark.parametrize("library", ["statsmodels", "distributed"])
def test_a_missing_library_is_named_before_anything_is_computed(table, tmp_path, capsys, without, library):
    without(library)
    assert main(["cohort", str(table), "--output", str(tmp_path / "out")]) == 6
    assert f"{library}, which is not installed: pip install 'palpate[cohort]'" in capsys.readouterr().err


def test_a_table_of_somebodys_own_is_never_replaced(table, tmp_path, capsys):
    assert main(["cohort", str(table), "--output", str(tmp_path)]) == 2
    assert "is an input of this run" in capsys.readouterr().err
    assert main(["cohort", str(table), "--output", str(tmp_path), "--shard", "1/2"]) == 2
    assert "is an input of this run" in capsys.readouterr().err
    (tmp_path / "out").mkdir()
    (tmp_path / "out/cohort.csv").write_text("mine")
    assert main(["cohort", str(table), "--output", str(tmp_path / "out")]) == 2
    assert "of no cohort of Palpate's" in capsys.readouterr().err
    assert (tmp_path / "out/cohort.csv").read_text() == "mine"
    assert table.read_text() == TABLE


def test_there_is_no_status_of_a_folder_without_a_cohort(tmp_path, capsys):
    assert main(["status", str(tmp_path)]) == 3
    assert "so no cohort" in capsys.readouterr().err


def test_shards_work_in_one_folder_and_the_last_one_writes_the_tables(table, tmp_path, capsys, monkeypatch):
    """Their rows fail, for there is no template, so no process is needed."""
    monkeypatch.setattr("palpate.cohort.cluster.outcomes", lambda tasks, **_: map(estimate_row, tasks))
    output = tmp_path / "out"
    output.mkdir()
    with folder_lock(output):  # by another one
        assert main(["cohort", str(table), "--output", str(output), "--shard", "2/2"]) == 0
        assert "1 failed, 1 waiting; the tables follow" in capsys.readouterr().out
        assert not (output / "cohort.csv").exists()
        assert main(["cohort", str(table), "--output", str(output), "--shard", "1/2"]) == 0
        assert "2 failed" in capsys.readouterr().out
    rows = list(csv.DictReader((output / "cohort.csv").read_text().splitlines()))
    assert [row["failure_class"] for row in rows] == ["usage", "usage"]


def test_an_interrupt_ends_a_run_with_its_exit_code(table, tmp_path):
    command = [sys.executable, "-m", "palpate", "cohort", str(table), "--output", str(tmp_path / "out")]
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(place for place in sys.path if place)}
    with (tmp_path / "said").open("w+b") as said:
        run = subprocess.Popen([*command, "--workers", "1"], env=environment, stderr=said, process_group=0)
        while not (tmp_path / "out/plan.json").exists():
            assert run.poll() is None
            time.sleep(0.02)
        os.killpg(run.pid, signal.SIGINT)  # as a terminal does
        assert run.wait(60.0) == 130
    words = (tmp_path / "said").read_text()
    assert words.splitlines()[-1].startswith("palpate: interrupted")
    assert "Traceback" not in words
