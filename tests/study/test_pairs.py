"""Several reference states of one patient share one set of moduli; a simulation needs no later image."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from case_texts import BALLS, case_text
from palpate.body.read import read_pairs
from palpate.case.file import read_case
from palpate.cli import main
from palpate.errors import ConfigurationError
from palpate.images.readers import write_label_image
from scenes import coarse_balls

TISSUES = BALLS | {name: BALLS[name] | {"youngs_modulus_kpa": kpa} for name, kpa in (("core", 60.0), ("shell", 30.0))}
CASE = case_text(TISSUES, before="before_2.nii.gz")
COARSE = [
    *("mechanics.law=linear", "mechanics.element=P1", "mesh.edge_length_mm=8", "driver.modes=12"),
    *("estimate.start_ratios=[3.0]", "estimate.samples=100", "discrepancy.layer_sd=0"),
]
PAIR = """
[[pairs]]
before = "other/before_3.nii.gz"
after = ["other/after.nii.gz"]
"""


@pytest.fixture(scope="module")
def inputs(tmp_path_factory) -> Path:
    """Two pairs of images of balls with the same moduli, squeezed in different ways, on different grids."""
    folder = tmp_path_factory.mktemp("pairs")
    (folder / "other").mkdir()
    for seed, place, voxel_mm in ((2, folder, 1.5), (3, folder / "other", 1.4)):
        scene = coarse_balls(seed, voxel_mm)
        write_label_image(place / f"before_{seed}.nii.gz", scene.before)
        write_label_image(place / "after.nii.gz", scene.after)
    (folder / "case.toml").write_text(CASE + PAIR)
    return folder


@pytest.fixture(scope="module")
def outputs(inputs, tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("outputs")
    assert run("estimate", inputs / "case.toml", folder) == 0
    return folder


def run(command: str, case: Path, output: Path) -> int:
    settings = [word for setting in COARSE for word in ("--set", setting)]
    return main([command, str(case), "--output", str(output), "--quiet", *settings])


def test_both_pairs_have_their_fit_mesh_and_digest_under_one_set_of_moduli(outputs):
    result = json.loads((outputs / "result.json").read_text())
    assert result["status"] == "converged"
    assert [item["tissue"] for item in result["estimates"]] == ["core", "shell"]
    assert result["estimates"][1]["value"] == pytest.approx(30.0, rel=0.4)
    names = [fit["after"] for fit in result["fit"]]
    assert [name.rsplit("/")[-1] for name in names] == ["after.nii.gz"] * 2
    assert names[1] == "other/after.nii.gz"
    for fit in result["fit"]:
        assert fit["shell"]["end"]["rms_mm"] < 0.6 * fit["shell"]["start"]["rms_mm"]
    assert result["pairs"][0]["mesh"]["tets"] != result["mesh"]["tets"]
    assert {"before", "after[0]", "pairs[0].before", "pairs[0].after[0]"} == set(result["inputs"])
    page, meshes = {"report.html", "report-data.npz"}, {"mesh.vtu", "mesh_2.vtu", "model.npz", "posterior.nc"}
    assert set(result["files"]) == meshes | page | {"stiffness.nii.gz", "labels.csv", "labels.nii.gz", "case.toml"}
    for found, estimate in zip(result["samples"]["moduli"], result["estimates"], strict=True):
        assert found["tissue"] == estimate["tissue"]
        assert found["interval95"][0] < estimate["value"] < found["interval95"][1]
    page = (outputs / "report.html").read_text()
    assert "Slices: before_2.nii.gz" in page
    assert "Slices: before_3.nii.gz" in page


def test_findings_on_a_further_pair_name_it_once(outputs, inputs):
    case = read_case(inputs / "case.toml", COARSE)
    _, states = read_pairs(case)
    said = [warning["message"] for warning in json.loads((outputs / "result.json").read_text())["warnings"]]
    assert states.findings
    for finding in states.findings:
        of_pair_2 = f"{finding.place} of pair 2" if finding.place else f"Pair 2: {finding.message}"
        assert any(of_pair_2 in message for message in said), said
    assert not any("Pair 2: Pair 2" in message for message in said)


def test_pairs_without_images_are_refused(tmp_path):
    path = tmp_path / "case.toml"
    path.write_text('[phantom]\nkind = "spheres"\n' + PAIR)
    with pytest.raises(ConfigurationError, match=r"\[\[pairs\]\] without \[images\]"):
        read_case(path)


def test_a_filling_needs_no_later_image(inputs, tmp_path):
    case = inputs / "filling.toml"
    case.write_text(CASE.replace('after = ["after.nii.gz"]\n', "") + "[motion]\nfilling_mm = 1.0\n")
    assert run("simulate", case, tmp_path) == 0
    moved = json.loads((tmp_path / "simulation.json").read_text())["largest_displacement_mm"]
    assert moved == pytest.approx(1.0, rel=0.5)


@pytest.mark.parametrize("motion", ["", "[motion]\nfilling_mm = 1.0\n"])
def test_an_estimate_without_a_later_image_names_the_key(motion, inputs, tmp_path, capsys):
    case = inputs / "alone.toml"
    case.write_text(CASE.replace('after = ["after.nii.gz"]\n', "") + motion)
    assert run("estimate", case, tmp_path / "out") == 2
    assert "the key 'after' is missing in [images]" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()
