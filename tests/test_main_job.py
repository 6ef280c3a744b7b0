"""The main job through the command line: two label images in, every file out; and what a bad input gets instead."""

from __future__ import annotations

import gzip
import json
import shutil
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
    *(
        "result.json",
        "report.html",
        "report-data.npz",
        "mesh.vtu",
        "model.npz",
        "stiffness.nii.gz",
        "labels.csv",
        "labels.nii.gz",
        "case.toml",
        "log.txt",
    ),
}
ESTIMATE_KEYS = {
    *("tissue", "parameter", "unit", "value", "interval95", "interval_kind", "relative_to", "ratio"),
    *("ratio_interval95", "verdict", "why", "truth", "variance_shares", "profile", "interval95_given_model"),
}
KEYS = {
    *("schema", "id", "status", "reason", "law", "element", "method", "estimates", "correlation", "fit", "starts"),
    *("counts", "mesh", "seconds", "inputs", "versions", "seed", "warnings", "frame", "offsets", "heterogeneity"),
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


def test_the_result_has_every_key_of_its_schema(result):
    assert set(result) >= KEYS
    assert (result["schema"], result["id"], result["seed"]) == ("palpate.result/1", "balls-1", 3)
    shell = result["estimates"][1]
    assert set(shell) == ESTIMATE_KEYS
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
    assert {"start", "end", "observed_share"} == set(fit["shell"])
    assert {"mean_mm", "rms_mm", "hd95_mm", "dice"} == set(fit["shell"]["end"])
    assert len(result["starts"]) == 15  # the case's two, and thirteen that cover the bounds
    assert {"start", "end", "objective_mm2", "status", "iterations"} <= set(result["starts"][0])
    assert {"forward", "adjoint", "tangent", "factorisations", "evaluations"} == set(result["counts"])
    figures = {"nodes", "tets", "dofs", "min_dihedral_deg", "p5_dihedral_deg", "volume_error"}
    figures |= {"edge_length_mm", "edge_length_reason"}
    assert figures == set(result["mesh"])
    assert {"read", "mesh", "assemble", "estimate", "total"} == set(result["seconds"])
    assert {"before", "after[0]"} == set(result["inputs"])
    assert {"python", "palpate", "numpy"} <= set(result["versions"])
    assert all(set(warning) == {"code", "message", "help"} for warning in result["warnings"])


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


def test_the_report_stands_alone_and_states_the_result(outputs, result):
    report = (outputs / "report.html").read_text()
    assert f"{result['estimates'][0]['value']:.1f}" in report
    assert 'src="http' not in report
    assert "<script" not in report or "http" not in report.split("<script", 1)[1].split("</script>", 1)[0]


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
    settings = ["tissues.surroundings.role=estimate", "estimate.start_ratios=[0.3]", "noise.surface_sd_mm=0.05"]
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


def _missing(folder: Path) -> None:
    (folder / "after.nii.gz").unlink()


def _empty(folder: Path) -> None:
    (folder / "after.nii.gz").write_bytes(b"")


def _truncated(folder: Path) -> None:
    content = (folder / "after.nii.gz").read_bytes()
    (folder / "after.nii.gz").write_bytes(content[: len(content) // 2])


def _no_image(folder: Path) -> None:
    (folder / "after.nii.gz").write_bytes(gzip.compress(b"these are words" * 100))


def _identical(folder: Path) -> None:
    shutil.copy(folder / "before.nii.gz", folder / "after.nii.gz")


def _relabelled(folder: Path) -> None:
    image = nibabel.load(folder / "after.nii.gz")
    labels = np.asarray(image.dataobj).copy()
    labels[labels == 2] = 3
    nibabel.save(nibabel.Nifti1Image(labels, image.affine), folder / "after.nii.gz")


BAD_FILES = {
    "a missing image": (_missing, 3, ["there is no file", "after.nii.gz", "check the path"]),
    "an empty image": (_empty, 3, ["is empty (0 bytes)", "export or copy"]),
    "a truncated image": (_truncated, 3, ["after.nii.gz", "cut short"]),
    "words instead of an image": (_no_image, 3, ["after.nii.gz", "does not begin"]),
    "identical images": (_identical, 3, ["the same label image", "check the two paths"]),
    "a label absent in the later image": (
        _relabelled,
        3,
        ["'shell' (label 2", "no voxel in 'after'", "check its label"],
    ),
}
BAD_SETTINGS = {
    "tissues.shell.label=9": (3, ["'shell' (label 9", "no voxel in 'before'", "check its label"]),
    "tissues.shell.label=1": (2, ["label 1 is claimed", "'core'", "'shell'", "one tissue only"]),
    "mesh.edge_lenght_mm=4": (2, ["unknown key 'edge_lenght_mm' in [mesh]", "did you mean 'edge_length_mm'?"]),
    "tissues.shell.roll=known": (2, ["unknown key 'roll'", "did you mean 'role'?"]),
    "tissues.shell.role=estimated": (2, ["'estimated'", "did you mean 'estimate'?"]),
    "tissues.shell.poisson_ratio=0.5": (2, ["[tissues.shell]", "0.5", "-1 < nu < 0.5", "usually has 0.40 to 0.49"]),
    "tissues.surroundings.youngs_modulus_kpa=-10": (2, ["[tissues.surroundings]", "-10", "a positive number in kPa"]),
    "tissues.surroundings.youngs_modulus_kpa=0": (2, ["[tissues.surroundings]", "a positive number in kPa"]),
    "mesh.edge_length_mm=500": (4, ["edge_length_mm is 500", "smallest side"]),
    "mechanics.law=neo-hooke": (2, ["'neo-hooke'", "did you mean 'neo-hookean'?"]),
    "estimate.parameters=['poisson_ratio']": (2, ["[estimate] parameters", "always estimated", "on demand"]),
}


def _refusal(case: Path, output: Path, capfd, *flags: str) -> tuple[int, str]:
    """Exit code and sentence of an estimate that is refused; earlier outputs must be as they were."""
    output.mkdir(exist_ok=True)
    earlier = {name: f"earlier {name}" for name in FILES - {"log.txt", "case.toml"}}
    for name, content in earlier.items():
        (output / name).write_text(content)
    code = main(["estimate", str(case), "--output", str(output), "--quiet", *flags])
    out, err = capfd.readouterr()
    assert out == ""
    assert "Traceback" not in err
    assert {name: (output / name).read_text() for name in earlier} == earlier
    assert {path.name for path in output.iterdir()} <= FILES
    return code, err


@pytest.mark.parametrize("name", BAD_FILES)
def test_a_bad_file_gets_a_sentence_and_touches_nothing(inputs, tmp_path, capfd, name):
    spoil, code, words = BAD_FILES[name]
    folder = tmp_path / "inputs"
    shutil.copytree(inputs, folder)
    spoil(folder)
    found, sentence = _refusal(folder / "case.toml", tmp_path / "out", capfd)
    assert found == code
    assert len(sentence.strip().splitlines()) == 1
    assert [word for word in words if word not in sentence] == [], sentence


@pytest.mark.parametrize("setting", BAD_SETTINGS)
def test_a_bad_setting_gets_a_sentence_and_touches_nothing(inputs, tmp_path, capfd, setting):
    code, words = BAD_SETTINGS[setting]
    found, sentence = _refusal(inputs / "case.toml", tmp_path / "out", capfd, "--set", setting)
    assert found == code
    assert len(sentence.strip().splitlines()) == 1
    assert [word for word in words if word not in sentence] == [], sentence


def test_a_refusal_in_json_is_a_document_too(inputs, tmp_path, capfd):
    flags = ["--output", str(tmp_path), "--json", "--quiet", "--set", "tissues.shell.label=9"]
    assert main(["estimate", str(inputs / "case.toml"), *flags]) == 3
    document = json.loads(capfd.readouterr().out)
    assert (document["schema"], document["error"], document["exit_code"]) == ("palpate.error/1", "InputDataError", 3)


def test_a_body_that_nothing_moves_is_refused(inputs, tmp_path, capfd):
    """Without a driver, and without a bone that moves, the displacement is zero whatever the moduli."""
    settings = ("--set", "tissues.frame.role=rigid", "--set", "images.align=none")
    found, sentence = _refusal(inputs / "case.toml", tmp_path / "out", capfd, *settings)
    assert found == 2
    assert "nothing moves this body" in sentence
    assert "Give the role driver" in sentence
