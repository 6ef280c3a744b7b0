"""A result folder is exported whole, as the run left it, or refused with a sentence."""

from __future__ import annotations

import dataclasses
import gzip
import json
import shutil
import zipfile
from dataclasses import fields

import numpy as np
import pytest

import palpate
from bodies import with_first_pair
from palpate.case.case import Images
from palpate.cli import main
from palpate.errors import ConfigurationError, EstimationError, InputDataError
from palpate.export.fitted_model import fitted_model
from palpate.export.formats import FORMATS
from palpate.export.model_file import read_model
from palpate.report import case_report
from palpate.study.earlier import seal_of
from palpate.study.outputs import sha256_of


def save(result, folder):
    """As `CaseResult.save` does, without drawing the page."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(case_report, "write_case_report", lambda _, area: (area / "report.html").write_text("a page"))
        palpate.CaseResult(**{f.name: getattr(result, f.name) for f in fields(result)}).save(folder)
    return folder


@pytest.fixture(scope="module")
def saved(case_result, tmp_path_factory):
    return save(case_result, tmp_path_factory.mktemp("saved") / "out")


@pytest.fixture
def folder(saved, tmp_path):
    """A copy to be spoilt."""
    return shutil.copytree(saved, tmp_path / "result")


def test_the_model_comes_back_from_its_file(saved, case_result):
    assert_same(read_model(saved), fitted_model(case_result, seal=seal_of(case_result.to_dict())))


def assert_same(found, expected):
    assert type(found) is type(expected)
    if isinstance(expected, np.ndarray):
        np.testing.assert_array_equal(found, expected)
    elif isinstance(expected, tuple | list):
        assert len(found) == len(expected)
        for pair in zip(found, expected, strict=True):
            assert_same(*pair)
    elif dataclasses.is_dataclass(expected):
        for field in fields(expected):
            assert_same(getattr(found, field.name), getattr(expected, field.name))
    else:
        assert found == expected


def test_a_folder_and_its_result_are_exported_alike(saved, case_result, tmp_path):
    first = palpate.export(saved, tmp_path / "one", format="abaqus")
    second = palpate.export(case_result, tmp_path / "two", format="abaqus")
    assert [path.name for path in first] == ["palpate.inp", "palpate_hybrid.inp"]
    assert [path.read_bytes() for path in first] == [path.read_bytes() for path in second]


def test_the_command_says_what_it_wrote(saved, tmp_path, capsys):
    assert main(["export", str(saved), "--format", "gmsh", "--output", str(tmp_path / "out"), "--json"]) == 0
    document = json.loads(capsys.readouterr().out)
    assert document == {"schema": "palpate.export/1", "format": "gmsh", "files": ["palpate.msh"]}
    assert {path.name for path in (tmp_path / "out").iterdir()} == {"palpate.msh"}


def spoil_result(folder):
    document = json.loads((folder / "result.json").read_text())
    document["estimates"][0]["value"] = 12.3
    (folder / "result.json").write_text(json.dumps(document))


def of_another_version(folder):
    path = folder / "result.json"
    path.write_text(path.read_text().replace("palpate.result/1", "palpate.result/2"))


def without_model(folder):
    document = json.loads((folder / "result.json").read_text())
    del document["files"]["model.npz"]
    (folder / "result.json").write_text(json.dumps(document))


def linked(folder):
    (folder / "mesh.vtu").rename(folder / "other.vtu")
    (folder / "mesh.vtu").symlink_to(folder / "other.vtu")


@pytest.mark.parametrize(
    ("spoil", "sentence"),
    [
        (lambda folder: (folder / "mesh.vtu").unlink(), "incomplete"),
        (linked, "incomplete"),
        (lambda folder: (folder / "labels.csv").write_text("1,liver"), "was changed"),
        (lambda folder: (folder / "model.npz").write_bytes(b"PK"), "was changed"),
        (spoil_result, "one of them was changed"),
        (of_another_version, "has the schema 'palpate.result/2'"),
        (without_model, "without model.npz"),
        (lambda folder: (folder / "result.json").unlink(), "there is no"),
    ],
)
def test_a_folder_that_is_not_as_the_run_left_it_is_refused(folder, tmp_path, capsys, spoil, sentence):
    spoil(folder)
    assert main(["export", str(folder), "--format", "stl", "--output", str(tmp_path / "out")]) == 3
    assert sentence in capsys.readouterr().err
    assert not (tmp_path / "out").exists()
    with pytest.raises(InputDataError):
        palpate.export(folder, tmp_path / "out", format="stl")


def test_a_report_drawn_again_leaves_the_folder_fit_for_export(folder, tmp_path):
    (folder / "report.html").write_text("another page")
    document = json.loads((folder / "result.json").read_text())
    document["files"]["report.html"]["sha256"] = sha256_of(folder / "report.html")
    (folder / "result.json").write_text(json.dumps(document))
    assert palpate.export(folder, tmp_path / "out", format="csv")


def test_what_did_not_converge_is_not_exported(case_result, tmp_path):
    estimation = dataclasses.replace(case_result.estimation, status="not converged")
    result = dataclasses.replace(case_result, estimation=estimation)
    with pytest.raises(EstimationError, match="did not converge"):
        palpate.export(result, tmp_path / "out", format="stl")
    save(result, tmp_path / "failed")
    assert not (tmp_path / "failed" / "model.npz").exists()
    with pytest.raises(EstimationError, match="not converged"):
        palpate.export(tmp_path / "failed", tmp_path / "out", format="stl")
    assert not (tmp_path / "out").exists()


def test_an_unknown_format_and_the_results_own_folder_are_refused(saved, tmp_path, capsys):
    with pytest.raises(ConfigurationError, match="choose among abaqus"):
        palpate.export(saved, tmp_path / "out", format="nastran")
    with pytest.raises(ConfigurationError, match="which stays alone"):
        palpate.export(saved, saved, format="stl")
    assert main(["export", str(saved), "--format", "stl", "--output", str(saved)]) == 2
    assert "which stays alone" in capsys.readouterr().err


def test_chains_are_a_file_of_their_run_and_go_on_from_the_folder(sampled_result, tmp_path):
    folder = save(sampled_result, tmp_path / "out")
    document = json.loads((folder / "result.json").read_text())
    assert document["files"]["posterior.nc"]["sha256"] == sha256_of(folder / "posterior.nc")
    assert_same(read_model(folder).samples, sampled_result.estimation.samples)
    (path,) = palpate.export(folder, tmp_path / "nc", format="netcdf")
    assert path.read_bytes() == (folder / "posterior.nc").read_bytes()
    (folder / "posterior.nc").write_bytes(b"CDF")
    with pytest.raises(InputDataError, match="was changed"):
        palpate.export(folder, tmp_path / "changed", format="netcdf")


@pytest.mark.parametrize("changes", [{"samples": None}, {"status": "not converged"}])
def test_without_chains_there_is_no_file_of_them_and_an_earlier_one_goes(sampled_result, tmp_path, changes):
    folder = save(sampled_result, tmp_path / "out")
    save(
        dataclasses.replace(sampled_result, estimation=dataclasses.replace(sampled_result.estimation, **changes)),
        folder,
    )
    assert json.loads((folder / "result.json").read_text())["samples"] is None
    assert not (folder / "posterior.nc").exists()


def test_each_further_pair_has_a_folder_of_its_own(case_result, tmp_path):
    r = case_result
    estimation = dataclasses.replace(r.estimation, displacements=(r.displacements[0], 0.5 * r.displacements[0]))
    both = dataclasses.replace(r, pairs=2 * r.pairs, estimation=estimation)
    names = {path.relative_to(tmp_path).as_posix() for path in palpate.export(both, tmp_path, format="gmsh")}
    assert names == {"palpate.msh", "pair_2/palpate.msh"}


def test_several_later_images_are_steps_one_after_the_other(case_result, tmp_path):
    first = case_result.estimation.displacements[0]
    estimation = dataclasses.replace(case_result.estimation, displacements=(first, 1.5 * first))
    later = 2 * case_result.pairs[0].later
    two = dataclasses.replace(with_first_pair(case_result, later=later), estimation=estimation)
    for name in ("abaqus", "febio", "stl", "vtu", "warp"):
        assert palpate.export(two, tmp_path / name, format=name, linear=True)
    assert (tmp_path / "abaqus" / "palpate.inp").read_text().count("*END STEP") == 2
    text = (tmp_path / "febio" / "palpate.feb").read_text()
    assert text.count("<relative>1</relative>") == 3  # those of the second step, from where the first has ended
    assert {"warp_1.nii.gz", "warp_2.nii.gz"} <= {path.name for path in (tmp_path / "warp").iterdir()}


PLANTED = ("Meyer", "Erika", "ward_7", "hospital", "lobe of M.")


def planted_in(path):
    """Whether a file, or what is packed in it, holds something that was planted."""
    plain = path.read_bytes()
    packed = [gzip.decompress(plain)] if plain[:2] == b"\x1f\x8b" else []
    if plain[:2] == b"PK":
        with zipfile.ZipFile(path) as archive:
            packed = [archive.read(name) for name in archive.namelist()]
    return any(word.encode().lower() in content.lower() for content in (plain, *packed) for word in PLANTED)


def test_no_name_or_path_of_an_input_is_in_an_export(case_result, tmp_path, capsys):
    """Of the case only its tissues' names go on: not its id, a patient, a file, a folder or the labels' own names."""
    images = Images(tmp_path / "hospital" / "ward_7_before.nii.gz", (tmp_path / "hospital" / "ward_7_after.nii.gz",))
    case = dataclasses.replace(case_result.case, id="case-of-Meyer", patient="Erika", images=images)
    mesh = case_result.space.mesh
    called = tuple(dataclasses.replace(tissue, called=("lobe of M.",)) for tissue in mesh.tissues)
    space = dataclasses.replace(case_result.space, mesh=dataclasses.replace(mesh, tissues=called))
    before = dataclasses.replace(case_result.before, tissues=called)
    planted = dataclasses.replace(
        with_first_pair(case_result, space=space, before=before), case=case, note="told by Erika"
    )
    folder = save(planted, tmp_path / "hospital" / "result")
    assert planted_in(folder / "result.json")
    assert planted_in(folder / "case.toml")
    assert not planted_in(folder / "model.npz")
    for name in FORMATS:
        shared = tmp_path / "shared" / name
        assert main(["export", str(folder), "--format", name, "--output", str(shared), "--quiet"]) == 0
        files = [path for path in shared.rglob("*") if path.is_file()]
        assert files
        assert [path.name for path in files if planted_in(path)] == []
    assert capsys.readouterr().err == ""


def spoilt_model(folder, change):
    """Change the arrays of model.npz, and let the result vouch for them."""
    with np.load(folder / "model.npz") as stored:
        arrays = {name: change(name, array) for name, array in stored.items()}
    np.savez(folder / "model.npz", **arrays)
    document = json.loads((folder / "result.json").read_text())
    document["files"]["model.npz"]["sha256"] = sha256_of(folder / "model.npz")
    (folder / "result.json").write_text(json.dumps(document))


@pytest.mark.parametrize("place", range(6))
def test_a_model_of_largest_integers_is_refused_with_a_sentence(folder, tmp_path, capsys, place):
    with np.load(folder / "model.npz") as stored:
        whole = [name for name, array in stored.items() if array.dtype.kind == "i"]
    assert len(whole) <= 6
    chosen = whole[place % len(whole)]
    spoilt_model(folder, lambda name, a: np.full_like(a, np.iinfo(a.dtype).max) if name == chosen else a)
    assert main(["export", str(folder), "--format", "abaqus", "--output", str(tmp_path / "out"), "--quiet"]) == 3
    (line,) = capsys.readouterr().err.strip().splitlines()
    assert "model.npz does not hold the data of a run" in line


def test_a_model_with_displacements_of_other_points_is_refused(folder, tmp_path, capsys):
    points = len(read_model(folder).bodies[0].space.points)
    spoilt_model(folder, lambda _, a: a[:-1] if a.shape == (points, 3) else a)
    assert main(["export", str(folder), "--format", "abaqus", "--output", str(tmp_path / "out"), "--quiet"]) == 3
    assert "displacements of other points than its mesh has" in capsys.readouterr().err
