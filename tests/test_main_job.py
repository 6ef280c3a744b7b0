"""The main job through the command line: two label images in, every file out."""

from __future__ import annotations

import json
import tomllib
from dataclasses import replace
from pathlib import Path

import jsonschema
import nibabel
import numpy as np
import pytest
import referencing

from case_texts import BALLS, case_text
from palpate.case.file import read_case
from palpate.case.json_schema import SCHEMAS
from palpate.cli import main
from palpate.export.model_file import read_model
from palpate.images.readers import write_label_image
from palpate.report.tornado import is_covered
from scenes import VOXEL_MM, balls

TRUTH_KPA = {"core": 60.0, "shell": 30.0}
CASE = case_text(
    BALLS,
    id="balls-1",
    seed=3,
    mechanics={"law": "linear"},  # as the truth
    mesh={"edge_length_mm": 10.0},
    driver={"modes": 20},
    estimate={"start_ratios": [1.0, 4.0]},
)
FILES = {
    *("result.json", "report.html", "report-data.npz", "mesh.vtu", "model.npz", "stiffness.nii.gz", "labels.csv"),
    *("labels.nii.gz", "case.toml", "log.txt"),
}


@pytest.fixture(scope="session")
def inputs(tmp_path_factory) -> Path:
    """A folder with both label images of two balls in one another that a frame squeezes, and the case."""
    folder = tmp_path_factory.mktemp("inputs")
    write_label_image(folder / "before.nii.gz", balls().before)
    write_label_image(folder / "after.nii.gz", balls().after)
    (folder / "case.toml").write_text(CASE)
    return folder


@pytest.fixture(scope="session")
def outputs(inputs, tmp_path_factory) -> Path:
    """What `palpate estimate` writes for them."""
    folder = tmp_path_factory.mktemp("outputs")
    assert main(["estimate", str(inputs / "case.toml"), "--output", str(folder), "--quiet"]) == 0
    return folder


@pytest.fixture
def result(outputs) -> dict:
    return json.loads((outputs / "result.json").read_text())


def test_an_estimate_writes_its_files_and_nothing_else(outputs):
    assert {path.name for path in outputs.iterdir()} == FILES
    assert min(path.stat().st_size for path in outputs.iterdir()) > 50


def test_the_case_beside_the_result_is_the_same_case(inputs, outputs):
    """With its images; that one case gives the same numbers again is a law of `test_identifiers.py`."""
    given, beside = (read_case(folder / "case.toml") for folder in (inputs, outputs))
    for ours, theirs in zip(
        (given.images.before, *given.images.after), (beside.images.before, *beside.images.after), strict=True
    ):
        assert theirs.samefile(ours)
    assert beside.resolve_tissues({}) == given.resolve_tissues({})  # what was left open there is written here
    assert replace(beside, images=given.images, tissues=given.tissues) == given


def test_the_case_in_the_result_is_the_one_beside_it(outputs, result):
    beside = tomllib.loads((outputs / "case.toml").read_text())
    named = {"before": "before.nii.gz", "after": ["after.nii.gz"], "align": "surfaces", "body_from_ct": False}
    assert result["case"] == beside | {"images": named}
    assert result["overrides"] == []


def test_the_result_meets_the_schema_that_is_shipped(result):
    schemas = {name: json.loads((SCHEMAS / name).read_text()) for name in ("case.schema.json", "result.schema.json")}
    registry = referencing.Registry().with_contents(schemas.items())
    jsonschema.Draft202012Validator(schemas["result.schema.json"], registry=registry).validate(result)


def test_poissons_ratios_that_were_fitted_stand_in_the_result_as_in_the_model_that_is_exported(outputs, result):
    body = read_model(outputs).bodies[0]
    exported = {tissue.name: tissue.poisson_ratio for tissue in body.mesh.tissues if tissue.meshed}
    assert {each["tissue"]: each["fitted"] for each in result["poisson_ratios"]} == pytest.approx(exported)
    for each in result["poisson_ratios"]:
        assert (each["stated"], each["pair"]) == (0.45, 1)
        assert 0.0 < each["sd"] <= 0.02  # what was believed of it, and what the images add
        assert abs(each["fitted"] - each["stated"]) < 3.0 * 0.02


def test_what_is_said_to_be_in_the_interval_has_a_share_in_the_variance_and_nothing_else(result):
    """By assumption, as the report and the sensitivity study say it."""
    causes = {
        "poisson_ratio": "poisson",
        "segmentation": "offset",
        "frame": "frame",
        "edge_length": "mesh",
        "known_modulus": "known modulus",
    }
    bars = {(each["cause"], each["subject"]) for each in result["variations"]} | {("edge_length", "")}
    assert {cause for cause, _ in bars} >= {"poisson_ratio", "segmentation", "known_modulus", "law"}
    for item in result["estimates"]:
        for cause, subject in bars:
            assert is_covered(result, cause, subject) == (causes.get(cause, "none") in item["variance_shares"]), cause


def test_the_truth_lies_within_the_interval(result):
    assert result["status"] == "converged", result["reason"]
    assert [item["tissue"] for item in result["estimates"]] == list(TRUTH_KPA)
    for item in result["estimates"]:
        truth = TRUTH_KPA[item["tissue"]]
        low, high = item["interval95"]
        assert low < truth < high
        assert item["value"] == pytest.approx(truth, rel=0.3)
        assert item["ratio"] == pytest.approx(item["value"] / 10.0)


def test_the_result_says_what_it_is_of_and_adds_up(result):
    assert (result["schema"], result["id"], result["seed"]) == ("palpate.result/1", "balls-1", 3)
    shell = result["estimates"][1]
    assert (shell["tissue"], shell["unit"], shell["relative_to"]) == ("shell", "kPa", "surroundings")
    assert shell["verdict"] in {"identified", "weak"}
    assert shell["interval_kind"] in {"linearised", "profile"}
    assert sum(shell["variance_shares"].values()) == pytest.approx(1.0)
    values, roots = zip(*shell["profile"], strict=True)
    assert sorted(values) == list(values)
    assert sorted(roots) == list(roots)
    assert np.diag(result["correlation"]) == pytest.approx(1.0)
    (fit,) = result["fit"]
    assert fit["after"] == "after.nii.gz"
    assert len(result["starts"]) == 15  # the case's two, and thirteen that cover the bounds
    assert {"forward", "adjoint", "tangent", "factorisations", "evaluations"} == set(result["counts"])
    assert {"read", "mesh", "assemble", "estimate", "total"} == set(result["seconds"])
    assert {"before", "after[0]"} == set(result["inputs"])
    assert {"python", "palpate", "numpy"} <= set(result["versions"])
    assert all("help" in warning for warning in result["warnings"])


def test_the_fit_is_better_than_the_rest_state(result):
    for name in ("core", "shell", "frame"):
        start, end = (result["fit"][0][name][when] for when in ("start", "end"))
        assert end["rms_mm"] < 0.9 * start["rms_mm"]  # what is left is that of voxels of 1.5 mm
        assert end["dice"] > start["dice"]
    assert result["fit"][0]["frame"]["end"]["rms_mm"] < 0.2 * VOXEL_MM


def test_the_stiffness_map_lies_on_the_reference_image(outputs, inputs, result):
    stiffness, before = (nibabel.load(p) for p in (outputs / "stiffness.nii.gz", inputs / "before.nii.gz"))
    assert np.allclose(stiffness.affine, before.affine)
    labels, values = np.asarray(before.dataobj), stiffness.get_fdata()
    for label, item in enumerate(result["estimates"], start=1):
        assert np.nanmedian(values[labels == label]) == pytest.approx(item["value"])
    assert np.nanmedian(values[labels == 4]) == 10.0
    assert np.isnan(values[labels == 3]).mean() > 0.9  # the frame is not meshed


def test_the_log_says_what_was_done(outputs):
    log = (outputs / "log.txt").read_text()
    for stage in ("palpate", "reading", "meshing", "15 starts", "intervals"):
        assert stage in log


def test_with_json_a_mesh_is_one_document_on_stdout(inputs, tmp_path, capfd):
    assert main(["mesh", str(inputs / "case.toml"), "--output", str(tmp_path), "--json"]) == 0
    out, err = capfd.readouterr()
    document = json.loads(out)
    assert document == json.loads((tmp_path / "mesh.json").read_text())
    assert document["mesh"]["min_dihedral_deg"] >= 5.0
    assert "mesh: " in err
    assert (tmp_path / "mesh.vtu").exists()


def test_simulating_with_the_truth_gives_the_later_image_back(inputs, tmp_path):
    flags = [f for name, kpa in TRUTH_KPA.items() for f in ("--set", f"tissues.{name}.youngs_modulus_kpa={kpa}")]
    command = ["simulate", str(inputs / "case.toml"), "--output", str(tmp_path), "--quiet", "--steps", "2"]
    assert main([*command, *flags]) == 0
    wanted, found = (np.asarray(nibabel.load(p / "after.nii.gz").dataobj) for p in (inputs, tmp_path))
    for label in (1, 2):
        both = np.count_nonzero((wanted == label) & (found == label))
        assert 2 * both / (np.count_nonzero(wanted == label) + np.count_nonzero(found == label)) > 0.96
    document = json.loads((tmp_path / "simulation.json").read_text())
    assert 1.0 < document["largest_displacement_mm"] < 5.0
    assert (tmp_path / "mesh.pvd").exists()
    assert len(list((tmp_path / "steps").iterdir())) == 3


def test_without_a_known_tissue_the_result_is_a_ratio(inputs, tmp_path):
    settings = ["tissues.surroundings.role=estimate", "estimate.start_ratios=[0.3]"]
    flags = [flag for setting in settings for flag in ("--set", setting)]
    code = main(["estimate", str(inputs / "case.toml"), "--output", str(tmp_path), "--quiet", *flags])
    assert code == 0
    result = json.loads((tmp_path / "result.json").read_text())
    assert [item["tissue"] for item in result["estimates"]] == ["shell", "surroundings"]
    for item, ratio in zip(result["estimates"], (30.0 / 60.0, 10.0 / 60.0), strict=True):
        assert (item["value"], item["interval95"], item["unit"], item["relative_to"]) == (None, None, "ratio", "core")
        low, high = item["ratio_interval95"]
        assert low < ratio < high
    assert "ratio-only" in {warning["code"] for warning in result["warnings"]}


def test_a_refusal_in_json_is_a_document_too(inputs, tmp_path, capfd):
    flags = ["--output", str(tmp_path), "--json", "--quiet", "--set", "tissues.shell.label=9"]
    assert main(["estimate", str(inputs / "case.toml"), *flags]) == 3
    document = json.loads(capfd.readouterr().out)
    assert (document["schema"], document["error"], document["exit_code"]) == ("palpate.error/1", "InputDataError", 3)
