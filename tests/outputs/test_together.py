"""The files in an output folder are of one run: all of the earlier one, or all of the new one."""

from __future__ import annotations

import errno
import hashlib
import json
import os
import signal
from pathlib import Path

import numpy as np
import pytest

from children import in_a_child
from palpate.cli import main
from palpate.images.label_image import LabelImage, VoxelGrid
from palpate.images.readers import write_label_image
from palpate.study import outputs

FILES = {
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
}
NO_SPACE = OSError(errno.ENOSPC, "No space left on device")


def contents(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in folder.iterdir() if path.name != "log.txt"}


def result(folder: Path) -> dict:
    return json.loads((folder / "result.json").read_text())


def among_the_renames(folder: Path) -> bool:
    """Whether it is decided that the new files take their places, and not all of them have."""
    return (folder / outputs.STAGING / outputs.READY).exists()


def refuse(error):
    def call(*_, **__):
        raise error

    return call


def test_a_result_lists_all_its_files_with_their_hashes(estimate, out):
    assert estimate("anna", "--quiet") == 0
    hashes = {
        name: hashlib.sha256((out / name).read_bytes()).hexdigest() for name in FILES - {"result.json", "log.txt"}
    }
    assert {name: entry["sha256"] for name, entry in result(out)["files"].items()} == hashes


@pytest.mark.parametrize("error", [NO_SPACE, MemoryError(), ValueError("no ink")])
def test_without_its_page_a_result_keeps_its_numbers_and_has_nobody_elses(estimate, out, capsys, error):
    assert estimate("anna", "--quiet") == 0
    assert estimate("bert", draw=refuse(error)) == 0
    assert result(out)["id"] == "bert"
    assert [warning["code"] for warning in result(out)["warnings"]] == ["report", "example"]  # others' come last
    assert {path.name for path in out.iterdir()} == FILES - {"report.html", "report-data.npz"}
    assert "report.html," not in capsys.readouterr().out
    assert main(["report", str(out)]) == 3
    assert "estimate again" in capsys.readouterr().err


def test_a_disk_that_is_full_after_the_page_costs_the_page_only(estimate, out):
    """It has room for all files but the page."""
    first, area = os.fsync, out / outputs.STAGING / outputs.NEW

    def on_a_small_disk() -> int:
        def full(file):
            if {"report.html", "result.json"} <= {path.name for path in area.glob("*")}:
                raise NO_SPACE
            first(file)

        os.fsync = full
        return estimate("bert", "--quiet")

    assert in_a_child(on_a_small_disk) == 0
    assert "report" in [warning["code"] for warning in result(out)["warnings"]]
    assert not (out / "report.html").exists()
    files = {"mesh.vtu", "model.npz", "stiffness.nii.gz", "labels.csv", "labels.nii.gz", "case.toml"}
    assert set(result(out)["files"]) == files


def test_a_page_that_nobody_vouches_for_is_set_aside(estimate, out):
    out.mkdir()
    (out / "report.html").write_text("of somebody")
    assert estimate("bert", "--quiet", draw=refuse(ValueError("no ink"))) == 0
    assert not (out / "report.html").exists()
    assert (out / "report.html.earlier").read_text() == "of somebody"
    assert any("report.html.earlier" in warning["message"] for warning in result(out)["warnings"])


def test_files_of_further_pairs_leave_with_the_result_that_lists_them(estimate, out):
    assert estimate("anna", "--quiet") == 0
    (out / "mesh_2.vtu").write_text("anna's")
    (out / "mesh_3.vtu").write_text("somebody's")
    document = result(out)
    document["files"]["mesh_2.vtu"] = {"sha256": hashlib.sha256(b"anna's").hexdigest()}
    (out / "result.json").write_text(json.dumps(document))
    assert estimate("bert", "--quiet") == 0
    assert not (out / "mesh_2.vtu").exists()
    assert (out / "mesh_3.vtu").read_text() == "somebody's"
    assert any("mesh_3.vtu in the output folder" in warning["message"] for warning in result(out)["warnings"])


@pytest.mark.parametrize("name", ["report-data.npz", "result.json"])
def test_a_page_is_drawn_of_no_other_run_than_the_result_tells_of(estimate, out, capsys, name):
    assert estimate("anna", "--quiet") == 0
    anna = (out / name).read_bytes()
    assert estimate("bert", "--quiet", "--set", "seed=1") == 0
    if name == "report-data.npz":
        (out / name).write_bytes(anna + b"\n")
    else:
        (out / name).write_bytes(anna.replace(b'sha256": "', b'sha256": "0'))
    before = contents(out)
    capsys.readouterr()
    assert main(["report", str(out)]) == 3
    assert "does not belong to the result beside it" in capsys.readouterr().err
    assert contents(out) == before


def test_the_page_drawn_again_is_that_of_the_result(estimate, out):
    """By a version that draws it otherwise."""
    pages = (f"page {number}" for number in range(2))
    assert estimate("anna", "--quiet", draw=lambda *_, **__: next(pages)) == 0
    assert main(["report", str(out), "--quiet"]) == 0
    assert (out / "report.html").read_text() == "page 1"
    assert result(out)["files"]["report.html"]["sha256"] == hashlib.sha256(b"page 1").hexdigest()


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT, signal.SIGHUP])
def test_a_signal_among_the_renames_finds_all_done_and_says_so(estimate, out, capfd, number):
    assert estimate("anna", "--quiet") == 0
    first = Path.replace

    def interrupted(path, target):
        done = first(path, target)
        if among_the_renames(out):
            os.kill(os.getpid(), number)
        return done

    def work() -> int:
        Path.replace = interrupted
        return estimate("bert", "--quiet")

    assert in_a_child(work) == 130
    (line,) = capfd.readouterr().err.strip().splitlines()
    assert "interrupted after these files were written: " in line
    assert "result.json" in line
    assert result(out)["id"] == "bert"
    assert main(["report", str(out), "--quiet"]) == 0
    assert (out / "report.html").read_text() == "the page of bert"


def test_a_signal_after_the_renames_says_that_they_are_done(estimate, out, capfd):
    assert estimate("anna", "--quiet") == 0
    unlink = Path.unlink

    def interrupted(path, *options, **named):
        if path.name == ".palpate.lock":  # the last thing that a run does in its folder
            os.kill(os.getpid(), signal.SIGTERM)
        return unlink(path, *options, **named)

    def work() -> int:
        Path.unlink = interrupted
        return estimate("bert", "--quiet")

    assert in_a_child(work) == 130
    (line,) = capfd.readouterr().err.strip().splitlines()
    assert "interrupted after these files were written: " in line
    assert result(out)["id"] == "bert"


def test_a_signal_before_the_renames_finds_none_done_and_says_so(estimate, out, capsys):
    assert estimate("anna", "--quiet") == 0
    before = contents(out)
    assert estimate("bert", "--quiet", meanwhile=lambda: os.kill(os.getpid(), signal.SIGHUP)) == 130
    assert "no file was changed" in capsys.readouterr().err
    assert contents(out) == before


@pytest.mark.parametrize("turn", [0, 1, 4, 7, 8])
def test_the_report_completes_what_a_kill_has_cut(estimate, out, turn):
    calls = []
    first = Path.replace

    def cut(path, target):
        calls.extend([target] if among_the_renames(out) else [])
        if len(calls) > turn:
            os.kill(os.getpid(), signal.SIGKILL)
        return first(path, target)

    def killed() -> int:
        Path.replace = cut
        return estimate("bert", "--quiet")

    assert estimate("anna", "--quiet") == 0
    assert in_a_child(killed) == -signal.SIGKILL
    assert main(["report", str(out), "--quiet"]) == 0
    assert (out / "report.html").read_text() == "the page of bert"
    assert result(out)["id"] == "bert"
    assert {path.name for path in out.iterdir()} == FILES


def test_what_a_killed_run_left_is_removed(estimate, out):
    (out / ".writing-outputs" / "new").mkdir(parents=True)
    (out / ".writing-outputs" / "new" / "mesh.vtu").write_text("half")
    assert estimate("anna", "--quiet") == 0
    assert {path.name for path in out.iterdir()} == FILES


@pytest.mark.parametrize("name", ["result.json", "report.html", "labels.csv", "mesh.vtu"])
@pytest.mark.parametrize("kind", ["folder", "link", "pipe"])
def test_a_place_that_no_file_can_take_is_found_before_the_estimate(estimate, out, tmp_path, capsys, name, kind):
    out.mkdir()
    (tmp_path / "mine").write_text("mine")
    {
        "folder": lambda path: path.mkdir(),
        "link": lambda path: path.symlink_to(tmp_path / "mine"),
        "pipe": os.mkfifo,
    }[kind](out / name)
    assert estimate("anna", "--quiet", meanwhile=lambda: pytest.fail("the estimate had begun")) == 6
    (line,) = capsys.readouterr().err.strip().splitlines()
    assert str(out / name) in line
    assert (tmp_path / "mine").read_text() == "mine"


def test_an_output_never_replaces_an_input(tmp_path, capsys):
    labels = np.zeros((6, 6, 6), dtype=int)
    labels[2:4, 2:4, 2:4] = 1
    for name in ("before", "after"):
        write_label_image(tmp_path / f"{name}.nii.gz", LabelImage(labels, VoxelGrid((6, 6, 6), np.eye(4))))
    (tmp_path / "case.toml").write_text(
        '[images]\nbefore = "before.nii.gz"\nafter = ["after.nii.gz"]\n'
        '[tissues.a]\nlabel = 1\nrole = "estimate"\nyoungs_modulus_kpa = 3.0\n'
        '[tissues.b]\nlabel = "remaining"\nrole = "known"\nyoungs_modulus_kpa = 1.0\n'
    )
    before = contents(tmp_path)
    assert main(["simulate", str(tmp_path / "case.toml"), "--output", str(tmp_path), "--quiet"]) == 2
    assert "before.nii.gz is an input of this run" in capsys.readouterr().err
    assert contents(tmp_path) == before


def test_a_disk_that_refuses_every_rename_leaves_all_to_the_next_run(estimate, out, capfd):
    assert estimate("anna", "--quiet") == 0
    first, calls = Path.replace, []

    def refused(path, target):
        calls.extend([target] if among_the_renames(out) else [])
        if len(calls) > 3:
            raise NO_SPACE
        return first(path, target)

    def work() -> int:
        Path.replace = refused
        return estimate("bert", "--quiet")

    assert in_a_child(work) == 6
    assert "the next command with this folder completes them" in capfd.readouterr().err
    assert main(["report", str(out), "--quiet"]) == 0
    assert (result(out)["id"], (out / "report.html").read_text()) == ("bert", "the page of bert")
    assert {path.name for path in out.iterdir()} == FILES
