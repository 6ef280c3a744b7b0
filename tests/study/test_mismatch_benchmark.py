"""What benchmarks/mismatch.py counts as held, as out and as an error; its scenes, on a coarse truth."""

import importlib.util
import json
import sys
from pathlib import Path

import numpy as np
import pytest

from palpate.case.file import read_case
from palpate.images.readers import read_label_image

FOLDER = Path(__file__).parents[2] / "benchmarks"


def loaded(name):
    """A module of benchmarks/, which is no package; the modules that it imports are loaded before it."""
    spec = importlib.util.spec_from_file_location(name, FOLDER / f"{name}.py")
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module
    spec.loader.exec_module(module)
    return module


@pytest.fixture(scope="module")
def rows():
    return loaded("rows")


@pytest.fixture(scope="module")
def scenes():
    module = loaded("scenes")
    module.TRUTH_EDGE_MM = 11.0
    return module


@pytest.fixture(scope="module")
def mismatch(scenes, rows):
    assert {scenes.__name__, rows.__name__} <= sys.modules.keys()
    return loaded("mismatch")


def item(value, interval, verdict="identified"):
    return {"tissue": "prostate", "value": value, "interval95": interval, "verdict": verdict}


def test_an_interval_is_measured_in_half_widths_of_ln_e(mismatch):
    found = mismatch.held_beside(item(10.0, [5.0, 20.0]), {"prostate": 40.0})
    assert found["ln_error"] == pytest.approx(np.log(0.25))
    assert found["half_widths"] == pytest.approx(2.0)
    assert not found["interval95_holds"]


def test_an_open_end_holds_and_no_interval_is_not_counted(mismatch):
    truth = {"prostate": 40.0}
    held, none, nothing = (
        mismatch.held_beside(each, truth) for each in (item(10.0, [5.0, None]), item(10.0, None), item(None, None))
    )
    assert held["interval95_holds"] is True
    assert held["half_widths"] is None
    assert none["interval95_holds"] is None
    assert nothing["ln_error"] is None
    cases = [
        {"seed": n, "status": "converged", "seconds": 1.0, "estimates": [e]}
        for n, e in enumerate((held, none, nothing))
    ]
    row = mismatch.summary_of([*cases, {"seed": 9, "error": "GeometryError: why"}])
    assert row["interval95_holds"] == {"share": 1.0, "intervals": 1}
    assert row["errors"] == ["9: GeometryError: why"]
    assert mismatch.COLUMNS["cases (errors)"](row) == "4 (1)"


def test_truths_that_lie_outside_by_two_half_widths_are_counted_by_verdict(mismatch):
    ends, truth = [9.0, 100.0 / 9.0], {"prostate": 20.0}
    estimates = [mismatch.held_beside(item(10.0, ends, verdict), truth) for verdict in ("identified", "weak")]
    row = mismatch.summary_of([{"seed": 1, "status": "converged", "seconds": 1.0, "estimates": estimates}])
    assert (row["out"], row["out_identified"]) == (2, 1)


def test_a_line_that_was_cut_off_is_computed_anew(rows, tmp_path):
    file, line = tmp_path / "lines.jsonl", {"scene": "still", "seed": 1, "law": "linear", "noise_mm": 0.0, "set": []}
    rows.append_line(file, line)
    file.write_text(file.read_text() + '{"scene": "cro')
    rows.append_line(file, line | {"seed": 2})
    assert [found["seed"] for found in rows.read_lines(file)] == [1, 2]


def test_a_job_is_run_once_and_lines_of_another_commit_are_compared(rows, tmp_path, capsys):
    def asked(*more):
        """The options of a campaign of two seeds."""
        parser = rows.parser_of("A campaign.", output=str(tmp_path / "lines.jsonl"), first_seed=5, seeds=2)
        return parser.parse_args(more)

    def jobs(options, value):
        return [rows.Job({"seed": seed}, lambda seed=seed: {"x": value * seed}) for seed in rows.seeds_of(options)]

    first = rows.collected(jobs(asked(), 1.0), asked(), ("seed",))
    assert (
        first
        == rows.collected(jobs(asked(), 2.0), asked(), ("seed",))
        == [{"seed": 5, "x": 5.0}, {"seed": 6, "x": 6.0}]
    )
    (tmp_path / "lines.jsonl").rename(tmp_path / "before.jsonl")
    options = asked("--share", "1/2", "--against", str(tmp_path / "before.jsonl"))
    assert rows.collected(jobs(options, 2.0), options, ("seed",)) == [{"seed": 6, "x": 12.0}]
    assert "x: 6.0 -> 12.0" in capsys.readouterr().err


@pytest.mark.parametrize("kind", ["crop", "all", "fov"])
def test_a_scene_is_a_case_that_is_made_once(scenes, tmp_path_factory, kind):
    cache = tmp_path_factory.getbasetemp() / "mismatch-scenes"
    folder = scenes.scene_folder(scenes.SceneKey(kind, 701), cache)
    made = (folder / "before.nii.gz").stat().st_mtime_ns
    assert scenes.scene_folder(scenes.SceneKey(kind, 701), cache) == folder
    assert (folder / "before.nii.gz").stat().st_mtime_ns == made
    case, told = read_case(folder / "case.toml"), json.loads((folder / "truth.json").read_text())
    assert told["simulated"]
    assert told["moduli_kpa"]["surroundings"] == 10.0
    before, after = (read_label_image(path) for path in (case.images.before, *case.images.after))
    assert set(np.unique(before.labels)) == set(np.unique(after.labels)) == {1, 2, 3, 4}
    if kind == "fov":
        assert min(before.labels.shape) > min(after.labels.shape)


def test_scenes_of_another_version_are_refused(scenes, tmp_path):
    folder = tmp_path / "still-1-linear-clean"
    folder.mkdir()
    (folder / "truth.json").write_text(json.dumps({"version": scenes.VERSION + 1}))
    with pytest.raises(SystemExit, match="another folder"):
        scenes.scene_folder(scenes.SceneKey("still", 1), tmp_path)
