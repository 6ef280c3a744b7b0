"""The commands of cohorts: what is refused before anything is computed, and what SLURM is asked for."""

from __future__ import annotations

import json
import stat
import sys
from pathlib import Path

import pytest

from palpate.cli import main
from palpate.cohort.engines.slurm import SlurmEngine, run_part
from palpate.cohort.run import Options, run_cohort
from palpate.cohort.task import Limits, Row, Task
from palpate.errors import ConfigurationError, ResourceError
from palpate.progress import silent
from palpate.study.lock import folder_lock

TABLE = "id,patient,stage,before,after\nr0,P,1,b.nii.gz,a.nii.gz\nr1,Q,x,b.nii.gz,a.nii.gz\n"


@pytest.fixture
def table(tmp_path):
    (tmp_path / "cohort.csv").write_text(TABLE)
    return tmp_path / "cohort.csv"


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        ([], "name the cohort's table"),
        (["TABLE", "--template", "nowhere.toml"], "there is no template"),
        (["TABLE", "--scheduler", "tcp://here:1"], "--scheduler goes with --engine dask"),
        (["TABLE", "--reference", "1"], "--reference goes with BIDS"),
        (["nowhere.csv"], "cannot read the table"),
    ],
)
def test_a_command_that_cannot_be_meant_is_refused(table, tmp_path, capsys, arguments, said):
    given = [str(table) if word == "TABLE" else word for word in arguments]
    assert main(["cohort", *given, "--output", str(tmp_path / "out")]) == 2
    assert said in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_two_runs_in_one_folder_are_refused(table, tmp_path, capsys):
    (tmp_path / "out").mkdir()
    with folder_lock(tmp_path / "out"):
        assert main(["cohort", str(table), "--output", str(tmp_path / "out")]) == 6
    assert "another run of palpate" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("library", "flags", "extra"), [("statsmodels", [], "cohort"), ("distributed", ["--engine", "dask"], "cluster")]
)
def test_a_missing_library_is_named_before_anything_is_computed(
    table, tmp_path, capsys, without, library, flags, extra
):
    without(library)
    assert main(["cohort", str(table), *flags, "--output", str(tmp_path / "out")]) == 6
    assert f"pip install 'palpate[{extra}]'" in capsys.readouterr().err


def test_a_table_of_somebodys_own_is_never_replaced(table, tmp_path, capsys):
    assert main(["cohort", str(table), "--output", str(tmp_path)]) == 2
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


SBATCH = """#!{python}
import json, pathlib, subprocess, sys
if pathlib.Path(sys.argv[0]).name == "sbatch":
    script = pathlib.Path(sys.argv[2])
    print("17;here")
    for part in range(len(json.loads(script.with_name("parts.json").read_text())["parts"])):
        subprocess.run(["sh", str(script)], env={{"SLURM_ARRAY_TASK_ID": str(part)}}, check=True)
"""
PART = """
import sys
from pathlib import Path
from palpate.cohort.engines import slurm
from palpate.cohort.engines.local import LocalEngine
slurm.LocalEngine = lambda workers: LocalEngine(workers, 4.0, "cohort_stub:work")
slurm.run_part(Path(sys.argv[sys.argv.index("--output") + 1]), int(sys.argv[-1]), lambda text: None)
"""


@pytest.fixture
def slurm_programs(tmp_path, environment):
    """Programs called sbatch, squeue and scancel; the first runs all parts of an array at once."""
    folder = tmp_path / "bin"
    folder.mkdir()
    for name in ("sbatch", "squeue", "scancel"):
        path = folder / name
        path.write_text(SBATCH.format(python=sys.executable))
        path.chmod(path.stat().st_mode | stat.S_IXUSR)
    environment(PATH=f"{folder}:/usr/bin:/bin")


@pytest.mark.usefixtures("slurm_programs")
def test_slurms_parts_leave_marks_and_what_is_lost_is_submitted_again(tmp_path):
    tests = str(Path(__file__).parents[1])
    command = (sys.executable, "-c", f"import sys; sys.path.insert(0, {tests!r})\n{PART}")
    row = Row("r0", "P", stage=1, covariates={"does": "refuse"})
    task = Task(row, str(tmp_path / "cases/r0"), "0" * 64, (), Limits(0.5, 2.0))
    (found,) = SlurmEngine(tmp_path, 3, command, poll_seconds=0.01).outcomes([task])
    assert (found.state, found.failure_class, found.attempts) == ("failed", "geometry", 1)
    script = (tmp_path / "slurm/array.sh").read_text()
    assert "#SBATCH --array=0-0%3\n" in script
    assert "#SBATCH --mem=1000M\n" in script
    assert json.loads((tmp_path / "slurm/job.json").read_text())["job"] == "17"
    assert run_part(tmp_path, 0, lambda _: None) == []  # its row has a mark
    gone = SlurmEngine(tmp_path, 3, ("true",), poll_seconds=0.01)
    lost = Task(Row("r9", "P"), str(tmp_path / "cases/r9"), "9" * 64)
    (outcome,) = gone.outcomes([lost])
    assert (outcome.failure_class, outcome.attempts) == ("lost", 3)


def test_without_slurm_its_engine_says_so(tmp_path, environment):
    environment(PATH=str(tmp_path))
    with pytest.raises(ResourceError, match="needs SLURM's sbatch"):
        next(SlurmEngine(tmp_path).outcomes([Task(Row("a", "P"), "nowhere")]))


class NoEngine:
    """One that computes nothing: every row stays as it is."""

    name = "none"

    def outcomes(self, _):
        return iter(())


def test_another_cohort_in_the_folder_is_refused_and_its_own_goes_on(tmp_path):
    ours, others = ([Row(f"{name}{i}", f"{name}{i}", problem="no image") for i in range(2)] for name in "pq")
    resumed = Options(resume=True)
    run_cohort(ours, tmp_path, NoEngine(), Options(), progress=silent)
    for rows, options, said in (
        (ours, Options(), "has a cohort already: --resume goes on with it"),
        (others, resumed, r"has another cohort: none of its 2 rows \('p0' ...\) is in this table"),
    ):
        with pytest.raises(ConfigurationError, match=said):
            run_cohort(rows, tmp_path, NoEngine(), options, progress=silent)
    run_cohort(ours[:1], tmp_path, NoEngine(), resumed, progress=silent)
    records = run_cohort(others, tmp_path, NoEngine(), Options(overwrite=True), progress=silent)
    assert [record.row.id for record in records] == ["q0", "q1"]
