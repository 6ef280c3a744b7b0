"""case.toml beside a result: written as it was run; a case of somebody's own is never replaced."""

from __future__ import annotations

import hashlib
import json
import shutil
import tomllib

import pytest

from palpate.case.file import read_case
from palpate.cli import main


def document(out):
    return json.loads((out / "result.json").read_text())


def test_the_case_as_it_was_run_stands_beside_its_result_until_the_next_run(estimate, out):
    assert estimate("anna", "--quiet", "--samples", "1000", "--set", "mesh.edge_length_mm=3") == 0
    tables = tomllib.loads((out / "case.toml").read_text())
    assert (tables["id"], tables["mesh"]["edge_length_mm"], tables["estimate"]["samples"]) == ("anna", 3, 1000)
    assert tables["images"]["before"] == (out.parent / "before.nii.gz").resolve().as_posix()
    assert "case.toml" in document(out)["files"]
    assert document(out)["overrides"] == ["estimate.samples=1000", "mesh.edge_length_mm=3"]
    assert document(out)["case"]["mesh"] == {"edge_length_mm": 3.0}
    assert document(out)["case"]["estimate"]["samples"] == 1000
    assert estimate("bert", "--quiet") == 0
    tables = tomllib.loads((out / "case.toml").read_text())
    assert (tables["id"], tables["estimate"]["samples"]) == ("bert", 0)
    assert document(out)["warnings"] == [{"code": "example", "message": "a warning to be shown"}]


def test_it_can_be_run_again_in_its_folder_wherever_that_was_moved_to(estimate, out, tmp_path_factory):
    assert estimate("anna", "--quiet") == 0
    first, images = (out / "case.toml").read_bytes(), read_case(out / "case.toml").images
    assert main(["estimate", str(out / "case.toml"), "--output", str(out), "--quiet"]) == 0
    assert (out / "case.toml").read_bytes() == first
    moved = tmp_path_factory.mktemp("elsewhere") / "deep" / "er"
    moved.parent.mkdir()
    shutil.move(out, moved)
    assert main(["estimate", str(moved / "case.toml"), "--output", str(moved), "--quiet"]) == 0
    assert read_case(moved / "case.toml").images == images


def test_an_input_is_not_replaced_by_the_case_with_its_overrides(estimate, out, capsys):
    assert estimate("anna", "--quiet") == 0
    before = (out / "case.toml").read_bytes()
    capsys.readouterr()
    assert main(["estimate", str(out / "case.toml"), "--output", str(out), "--set", "seed=3"]) == 2
    assert "case.toml is an input of this run" in capsys.readouterr().err
    assert (out / "case.toml").read_bytes() == before


def files(folder):
    return {path.name: path.read_bytes() for path in folder.iterdir()}


def test_the_result_of_another_case_is_replaced_only_if_that_is_asked_for(estimate, out, capsys):
    assert estimate("anna", "--quiet") == 0
    before, computed = files(out), []
    assert estimate("bert", overwrite=False, meanwhile=lambda: computed.append(1)) == 2
    said = capsys.readouterr().err
    assert f"{out} holds the result of another case, 'anna' (before: " in said
    assert "this one is 'bert'" in said
    assert "--overwrite" in said
    assert (computed, files(out)) == ([], before)
    assert estimate("bert", "--quiet") == 0
    assert document(out)["id"] == "bert"


@pytest.mark.parametrize("command", ["mesh", "simulate", "sensitivity"])
def test_no_other_command_works_in_the_folder_of_another_case(estimate, out, tmp_path, capsys, command):
    assert estimate("anna", "--quiet") == 0
    assert estimate("bert", "--quiet", "--output", str(tmp_path / "b")) == 0
    before = files(out)
    capsys.readouterr()
    assert main([command, str(tmp_path / "bert.toml"), "--output", str(out)]) == 2
    said = capsys.readouterr().err
    assert "holds the result of another case, 'anna'" in said
    assert "--overwrite" not in said, "the command has no such flag"
    assert files(out) == before


def test_the_same_case_after_an_edit_is_run_into_its_folder_again(estimate, out):
    for flags in ((), ("--set", "seed=3"), ("--set", "mechanics.law=linear")):
        assert estimate("anna", "--quiet", *flags, overwrite=False) == 0
    own = (out / "case.toml").read_text().replace('id = "anna"', 'id = "anna-2"').replace('patient = "anna"\n', "")
    (out / "case.toml").write_text(own)
    assert main(["estimate", str(out / "case.toml"), "--output", str(out), "--quiet"]) == 0


@pytest.mark.parametrize(("moved", "changed", "code"), [(True, False, 0), (False, True, 0), (True, True, 2)])
def test_another_image_under_the_same_id_is_another_case(estimate, out, tmp_path, capsys, moved, changed, code):
    image = tmp_path / "before.nii.gz"
    image.write_bytes(b"one")
    assert estimate("anna", "--quiet") == 0
    found = document(out) | {"inputs": {"before": {"sha256": hashlib.sha256(b"one").hexdigest()}}}
    (out / "result.json").write_text(json.dumps(found))
    folder = tmp_path / "elsewhere" if moved else tmp_path
    folder.mkdir(exist_ok=True)
    (folder / "before.nii.gz").write_bytes(b"two" if changed else b"one")
    shutil.copy(tmp_path / "anna.toml", folder / "case.toml")
    assert main(["estimate", str(folder / "case.toml"), "--output", str(out), "--quiet"]) == code
    assert ("holds the result of another case" in capsys.readouterr().err) == (code == 2)


def test_a_run_that_ended_without_values_is_no_result_to_keep(estimate, out):
    assert estimate("anna", "--quiet") == 0
    (out / "result.json").write_text(json.dumps(document(out) | {"status": "failed"}))
    (out / "case.toml").unlink()
    assert estimate("bert", "--quiet", overwrite=False) == 0


def test_a_case_of_somebodys_own_that_says_something_else_is_refused_at_once(estimate, out, capsys):
    out.mkdir()
    (out / "case.toml").write_text("# mine")
    computed = []
    assert estimate("anna", meanwhile=lambda: computed.append(1)) == 2
    assert "case.toml says something else than the case of this run" in capsys.readouterr().err
    assert not computed
    assert (out / "case.toml").read_text() == "# mine"


def test_a_case_of_somebodys_own_that_says_the_same_stays_with_its_comments(estimate, out):
    assert estimate("anna", "--quiet") == 0
    mine = "# why: see the ward's book\n" + (out / "case.toml").read_text()
    (out / "result.json").unlink()
    (out / "case.toml").write_text(mine)
    for _ in range(2):
        assert estimate("anna", "--quiet") == 0
        assert (out / "case.toml").read_text() == mine
        assert "case.toml" not in document(out)["files"]


def test_a_case_that_is_edited_during_the_run_keeps_the_edit_and_is_warned_of(estimate, out):
    assert estimate("anna", "--quiet") == 0
    edited = (out / "case.toml").read_text().replace('id = "anna"', 'id = "anna-2"')
    assert estimate("anna", "--quiet", meanwhile=lambda: (out / "case.toml").write_text(edited)) == 0
    assert (out / "case.toml").read_text() == edited
    assert "case-file" in [warning["code"] for warning in document(out)["warnings"]]
    assert "case.toml" not in document(out)["files"]
