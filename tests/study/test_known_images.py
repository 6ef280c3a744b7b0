"""A later image that is added to a finished estimate: the command, its files, and what is refused."""

from __future__ import annotations

import io
import json
import shutil
import zipfile
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import palpate
from case_texts import BALLS, LINEAR, case_text
from palpate.body.body import joint_problem, make_body
from palpate.body.read import read_states
from palpate.cli import main
from palpate.errors import ConfigurationError, InputDataError
from palpate.images.readers import write_label_image
from palpate.phantoms.spheres import SpheresOptions, spheres
from palpate.progress import silent
from palpate.statement.known_images import FORMAT, KnownImages, added_name, digest_of, why_together
from palpate.study.archive import read_archive, write_archive
from palpate.study.outputs import KNOWN_IMAGES

PUSHES = (3.0, 4.0, 5.0, -4.0)


def case_of(numbers) -> str:
    return case_text(
        BALLS,
        after=[f"after_{n}.nii.gz" for n in numbers],
        mechanics=LINEAR,
        mesh={"edge_length_mm": 8},
        driver={"modes": 12},
        discrepancy={"layer_sd": 0, "heterogeneity_sd": 0.1, "surface_offset_mm": 0.1},
    )


def run(folder: Path, *words: object) -> int:
    return main(["estimate", str(folder / "case.toml"), "--quiet", *map(str, words)])


@pytest.fixture(scope="module")
def inputs(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("images")
    for number, push in enumerate(PUSHES, start=1):
        scene = spheres(SpheresOptions(seed=2, spacing_mm=(2.0,) * 3, truth_edge_mm=8.0, push_mm=push))
        write_label_image(folder / "before.nii.gz", scene.before)
        write_label_image(folder / f"after_{number}.nii.gz", scene.after)
    (folder / "case.toml").write_text(case_of([1, 2]))
    (folder / "all.toml").write_text(case_of([1, 2, 3]).replace("[images]", 'id = "case"\n[images]', 1))
    return folder


@pytest.fixture(scope="module")
def earlier(inputs, tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("out") / "out"
    assert run(inputs, "--output", folder) == 0
    return folder


@pytest.fixture(scope="module")
def added(inputs, earlier) -> Path:
    assert run(inputs, "--add", inputs / "after_3.nii.gz", "--output", earlier) == 0
    return earlier / "added-after_3"


@pytest.fixture(scope="module")
def problem(inputs):
    """The inverse problem of the case, and its mesh."""
    case = palpate.read_case(inputs / "case.toml")
    body = make_body(read_states(case), case, progress=silent)
    return joint_problem((body,), case, progress=silent), body.space.mesh


def document(folder: Path):
    return json.loads((folder / "result.json").read_text())


def logs(of):
    return {item["tissue"]: np.log([*item["interval95"], item["value"]]) for item in of["estimates"]}


def test_an_added_image_counts_as_one_that_was_always_there(inputs, added, tmp_path):
    assert main(["estimate", str(inputs / "all.toml"), "--quiet", "--output", str(tmp_path / "all")]) == 0
    together, found = logs(document(tmp_path / "all")), logs(document(added))
    for tissue, (low, high, value) in together.items():
        sd = (high - low) / 3.92
        assert found[tissue][2] == pytest.approx(value, abs=0.5 * sd)
        assert (found[tissue][1] - found[tissue][0]) / 3.92 == pytest.approx(sd, rel=0.3)


def test_the_result_says_what_it_builds_on_and_the_earlier_one_stays(earlier, added):
    found, before = document(added), document(earlier)
    assert found["built_on"]["images"] == 2
    assert found["built_on"]["folder"] == "out"
    assert before["built_on"] is None
    assert found["note"].startswith("One later image was added")
    assert found["case"]["images"]["after"] == [f"after_{n}.nii.gz" for n in (1, 2, 3)]
    assert set(found["inputs"]) == {"before", "after[0]", "after[1]", "after[2]"}
    assert found["inputs"]["after[1]"] == before["inputs"]["after[1]"]
    assert [fit["after"] for fit in found["fit"]] == ["after_3.nii.gz"]
    assert all("earlier" in of["variance_shares"] for of in found["estimates"])
    assert "added to an earlier estimate" in (added / "report.html").read_text()
    assert len(palpate.read_case(added / "case.toml").images.after) == 3
    assert KNOWN_IMAGES in found["files"]


def test_the_chain_goes_on_from_the_folder_of_the_added_image(inputs, added):
    case = palpate.read_case(added / "case.toml")
    result = palpate.estimate(case, add=[inputs / "after_4.nii.gz"], earlier=added, progress=None)
    assert result.to_dict()["built_on"]["images"] == 3
    assert result.known.images.n_images == 4
    assert len(result.whole_case.images.after) == 4


def test_an_image_counts_once(inputs, earlier):
    case = palpate.read_case(inputs / "case.toml")
    with pytest.raises(ConfigurationError, match=r"'after_2.nii.gz' is the after\[1\] of the result in 'out' already"):
        palpate.estimate(case, add=[inputs / "after_2.nii.gz"], earlier=earlier, progress=None)


def test_another_reference_image_is_refused(inputs, earlier, tmp_path):
    scene = spheres(SpheresOptions(seed=3, spacing_mm=(2.0,) * 3, truth_edge_mm=8.0))
    write_label_image(tmp_path / "before.nii.gz", scene.before)
    case = palpate.read_case(inputs / "case.toml")
    case = replace(case, images=replace(case.images, before=tmp_path / "before.nii.gz"))
    with pytest.raises(ConfigurationError, match=r"reference image is not that of the result in 'out'"):
        palpate.estimate(case, add=[inputs / "after_3.nii.gz"], earlier=earlier, progress=None)


@pytest.mark.parametrize(
    ("override", "table"),
    [
        ("mechanics.law=neo-hookean", "mechanics"),
        ("tissues.surroundings.youngs_modulus_kpa=20.0", "tissues"),
        ("discrepancy.heterogeneity_sd=0.2", "discrepancy"),
        ('images.align="none"', "images"),
    ],
)
def test_a_case_with_other_settings_is_refused(inputs, earlier, override, table):
    case = palpate.read_case(inputs / "case.toml", [override])
    with pytest.raises(ConfigurationError, match=rf"differs from that of the result in .* in \[{table}\]"):
        palpate.estimate(case, add=[inputs / "after_3.nii.gz"], earlier=earlier, progress=None)


def test_without_a_result_nothing_is_added_and_no_folder_made(inputs, tmp_path, capsys):
    assert run(inputs, "--add", inputs / "after_3.nii.gz", "--output", tmp_path / "none") == 3
    assert "run the estimate first" in capsys.readouterr().err
    assert not (tmp_path / "none").exists()


def test_to_one_later_image_it_is_added_by_estimating_both(inputs, tmp_path):
    case = inputs / "one.toml"
    case.write_text(case_of([1]))
    out = tmp_path / "one"
    assert main(["estimate", str(case), "--quiet", "--output", str(out)]) == 0
    assert KNOWN_IMAGES not in document(out)["files"]
    assert main(["estimate", str(case), "--quiet", "--output", str(out), "--add", str(inputs / "after_2.nii.gz")]) == 0
    found = document(out / "added-after_2")
    assert found["built_on"] is None
    assert len(found["fit"]) == 2
    (warning,) = [of["message"] for of in found["warnings"] if of["code"] == "added-together"]
    assert warning.startswith("All 2 later images were estimated together: the earlier estimate has one later image")


def known_of(folder: Path) -> KnownImages:
    return read_archive(KnownImages, folder / KNOWN_IMAGES, version=FORMAT, finite=True)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"mesh": "0" * 64}, r"the mesh of the earlier estimate differs: '000000000000' there"),
        ({"tissues": ("core",)}, r"the tissues of the earlier estimate differs: 'core' there, 'core, shell' here"),
        ({"law": "neo-hookean"}, r"the law of the earlier estimate differs: 'neo-hookean' there, 'linear' here"),
        ({"marks": np.ones(3)}, r"the 3 modes of tissues and drawing come out otherwise"),
    ],
)
def test_what_another_body_has_told_is_refused(inputs, problem, earlier, change, words):
    case, known = palpate.read_case(inputs / "case.toml"), known_of(earlier)
    problem, mesh = problem
    assert digest_of(mesh) == known.mesh
    assert known.problem_with(problem, case).parameters.earlier
    with pytest.raises(ConfigurationError, match=words):
        replace(known, **change).problem_with(problem, case)


def test_the_file_is_small_and_names_no_patient(earlier):
    content = (earlier / KNOWN_IMAGES).read_bytes()
    assert len(content) < 2**21
    with np.load(earlier / KNOWN_IMAGES, allow_pickle=False) as arrays:
        text = arrays["json"].tobytes().decode()
    assert "after_" not in text
    assert str(earlier) not in text


def test_a_damaged_file_is_refused(inputs, earlier, tmp_path):
    known = known_of(earlier)
    for damaged in (
        lambda path: path.write_bytes(path.read_bytes()[:-100]),
        lambda path: path.write_bytes(b"PK"),
        lambda path: write_archive(replace_theta(known), path, version=FORMAT),
        larger_than_the_file,
    ):
        path = tmp_path / KNOWN_IMAGES
        write_archive(known, path, version=FORMAT)
        damaged(path)
        with pytest.raises(InputDataError, match="does not hold the data of a run"):
            read_archive(KnownImages, path, version=FORMAT, finite=True)
    folder = tmp_path / "out"
    shutil.copytree(earlier, folder)
    write_archive(known, folder / KNOWN_IMAGES, version="palpate.known-images/0")
    case = palpate.read_case(inputs / "case.toml")
    with pytest.raises(InputDataError, match="was changed after the estimate"):
        palpate.estimate(case, add=[inputs / "after_3.nii.gz"], earlier=folder, progress=None)


def larger_than_the_file(path: Path) -> None:
    """A head that asks for 8 TB."""
    with zipfile.ZipFile(path) as archive:
        members = {name: archive.read(name) for name in archive.namelist()}
    head = io.BytesIO()
    np.lib.format.write_array_header_1_0(head, {"descr": "<f8", "fortran_order": False, "shape": (10**6, 10**6)})
    with zipfile.ZipFile(path, "w") as archive:
        for name, content in members.items():
            archive.writestr(name, head.getvalue() if name == "a0.npy" else content)


def replace_theta(known: KnownImages) -> KnownImages:
    """The same, for more moduli than its laws have."""
    images = object.__new__(type(known.images))
    for name in ("n_images", "blocks", "laws"):
        object.__setattr__(images, name, getattr(known.images, name))
    object.__setattr__(images, "theta", np.zeros(len(known.images.theta) + 1))
    return replace(known, images=images)


def test_folders_are_called_by_the_image():
    assert added_name([Path("a b/after 7.nii.gz")]) == "added-after_7"
    assert added_name([Path("x.nrrd"), Path("y.nrrd")]) == "added-x-and-1-more"
    assert why_together(palpate.read_case, 1).startswith("the earlier estimate has one")


def test_an_earlier_estimate_that_leaves_a_modulus_open_is_made_again_with_all_images(inputs, tmp_path):
    """Its law is far from normal."""
    case, out = inputs / "open.toml", tmp_path / "open"
    case.write_text(case_of([1, 2]) + "[estimate]\nbounds_ratio = [0.5, 9.0]\nstart_ratios = [2.0]\n")
    assert main(["estimate", str(case), "--quiet", "--output", str(out)]) == 0
    assert KNOWN_IMAGES not in document(out)["files"]
    result = palpate.estimate(palpate.read_case(case), add=[inputs / "after_3.nii.gz"], earlier=out, progress=None)
    (warning,) = [of["message"] for of in result.to_dict()["warnings"] if of["code"] == "added-together"]
    assert "leaves a modulus open" in warning
    assert len(result.after) == 3
