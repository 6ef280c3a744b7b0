"""From Python everything goes as on the command line, with the same files and the same refusals."""

from __future__ import annotations

import dataclasses
import json
import subprocess
import sys
from importlib import metadata
from pathlib import Path

import pytest

import palpate
from case_texts import ORGAN, REST, case_text
from palpate.case.case import Estimate
from palpate.cli import main
from palpate.errors import ConfigurationError, InputDataError, ResourceError
from palpate.study import run
from palpate.study.lock import folder_lock

CASE = case_text({"prostate": ORGAN, "rectum": {"label": 2, "role": "driver"}, "body": REST})


def test_a_new_case_is_that_of_the_command(folder):
    images = [str(folder / f"{name}.nii.gz") for name in ("before", "after")]
    assert main(["init", *images, "--labels", str(folder / "names.json"), "--output", str(folder / "a")]) == 0
    case = palpate.init(*images, labels=folder / "names.json", output=folder / "b")
    assert case.path == folder / "b" / "case.toml"
    assert case.path.read_text() == (folder / "a" / "case.toml").read_text() == case.text
    assert [str(tissue.role) for tissue in case.tissues] == ["estimate", "driver", "known"]


def test_a_folder_that_is_refused_is_not_left_behind(folder):
    with pytest.raises(ConfigurationError, match="image before, then one or more after"):
        palpate.init(folder / "before.nii.gz", output=folder / "new" / "deeper")
    assert not (folder / "new").exists()


def test_a_check_is_that_of_the_command(folder, capfd):
    case = palpate.init(folder / "before.nii.gz", folder / "after.nii.gz", labels=folder / "names.json", output=folder)
    overrides = ["mesh.edge_length_mm=400", "images.before='nowhere.nii.gz'"]
    code = main(["check", str(case.path), "--json", "--set", overrides[0], "--set", overrides[1]])
    told = json.loads(capfd.readouterr().out)
    read = palpate.read_case(case.path, overrides)
    for report in (palpate.check(str(case.path), overrides), palpate.check(case.path, overrides), palpate.check(read)):
        assert (report.exit_code, code) == (3, 3)
        assert [problem["message"] for problem in told["problems"]] == [problem.message for problem in report.problems]


def test_a_mesh_is_made_of_a_case_whatever_its_path_is(folder):
    case = palpate.init(folder / "before.nii.gz", folder / "after.nii.gz", labels=folder / "names.json", output=folder)
    told: list[str] = []
    read = palpate.read_case(str(case.path), ["mesh.edge_length_mm=8"])
    assert read == palpate.read_case(Path(case.path), ["mesh.edge_length_mm=8"])
    result = palpate.make_mesh(read, progress=told.append)
    assert result.mesh_summary.tets == len(result.space.mesh.tets) > 100
    assert told[0] == "reading the images"


@pytest.mark.parametrize("module", ["h5py", "h5netcdf"])
def test_samples_without_their_libraries_are_refused_before_anything_is_read(tmp_path, without, capfd, module):
    path = tmp_path / "case.toml"
    path.write_text(CASE)
    without(module)
    with pytest.raises(ResourceError, match=r"h5netcdf, which is not installed: pip install 'palpate\[samples\]'"):
        palpate.estimate(palpate.read_case(path), samples=1000)
    assert main(["estimate", str(path), "--output", str(tmp_path / "out"), "--samples", "1000", "--quiet"]) == 6
    assert "pip install 'palpate[samples]'" in capfd.readouterr().err
    assert not (tmp_path / "out" / "result.json").exists()


@pytest.mark.parametrize("samples", [-1, 1, 99, 100_001])
def test_another_number_of_samples_than_can_be_drawn_is_refused(tmp_path, capfd, samples):
    path = tmp_path / "case.toml"
    path.write_text(CASE)
    with pytest.raises(ConfigurationError, match=rf"samples is {samples}; ask for 100 to 100000"):
        palpate.estimate(palpate.read_case(path), samples=samples)
    assert main(["estimate", str(path), "--output", str(tmp_path), "--set", f"estimate.samples={samples}"]) == 2
    assert f"is {samples}" in capfd.readouterr().err


def test_what_is_no_number_of_samples_is_a_matter_of_usage(tmp_path, capfd):
    with pytest.raises(SystemExit, match="2"):
        main(["estimate", str(tmp_path / "case.toml"), "--samples", "many"])
    assert "'many' is no whole number" in capfd.readouterr().err


def test_samples_asked_in_python_are_those_of_the_case(monkeypatch, case_result):
    monkeypatch.setattr(run, "estimate", lambda case, **__: dataclasses.replace(case_result, case=case))
    assert palpate.estimate(case_result.case, samples=1000).case.estimate.samples == 1000
    sampled = dataclasses.replace(case_result.case, estimate=Estimate(samples=1000))
    assert isinstance(palpate.estimate(sampled), palpate.CaseResult)
    assert palpate.estimate(sampled).case.estimate.samples == 1000
    assert palpate.estimate(sampled, samples=0).case.estimate.samples == 0


def test_an_estimate_can_be_saved_and_holds_its_folder(tmp_path, case_result):
    found = {field.name: getattr(case_result, field.name) for field in dataclasses.fields(case_result)}
    result = palpate.CaseResult(**found)
    paths = result.save(str(tmp_path / "out"))
    assert {path.name for path in paths} == {path.name for path in (tmp_path / "out").iterdir()}
    assert {"result.json", "report.html", "mesh.vtu", "case.toml"} <= {path.name for path in paths}
    (told,) = result.to_dict()["warnings"]
    assert json.loads((tmp_path / "out" / "result.json").read_text())["warnings"] == [told]
    read = palpate.read_result(tmp_path / "out")
    assert repr(read) == repr(result)
    assert read._repr_html_().count("<article") == result._repr_html_().count("<article")
    assert read.to_dataframe().equals(result.to_dataframe())
    with folder_lock(tmp_path / "out"), pytest.raises(ResourceError, match="another run"):
        result.save(tmp_path / "out")


def test_the_package_tells_what_it_has_before_anything_is_loaded():
    code = "import palpate; assert set(palpate.__all__) <= set(dir(palpate)); print(palpate.__version__)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == metadata.version("palpate")


def test_a_folder_that_holds_no_result_is_told(tmp_path):
    with pytest.raises(InputDataError, match=r"result\.json"):
        palpate.read_result(tmp_path)
    (tmp_path / "result.json").write_text('{"schema": "palpate.check/1"}')
    with pytest.raises(InputDataError, match="no result of an estimate"):
        palpate.read_result(tmp_path)
