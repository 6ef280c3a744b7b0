"""The files in an output folder are of one run, its document lists them, and its last words say whether they are."""

from __future__ import annotations

import errno
import json
import os
import signal
from pathlib import Path

import pytest

from children import in_a_child
from palpate.cli import main
from palpate.study.lock import NAME
from palpate.study.outputs import EARLIER, digests_of

FILES = {"result.json", "report.html", "report-data.npz", "mesh.vtu", "model.npz", "stiffness.nii.gz", "labels.csv"}
FILES |= {"labels.nii.gz", "case.toml", "log.txt"}
NO_SPACE = OSError(errno.ENOSPC, "No space left on device")


def contents(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in folder.iterdir() if path.is_file() and path.name != "log.txt"}


def result(folder: Path) -> dict:
    return json.loads((folder / "result.json").read_text())


def refuse(error):
    def call(*_, **__):
        raise error

    return call


def test_a_result_lists_all_its_files_with_their_hashes(estimate, out):
    assert estimate("anna", "--quiet") == 0
    found = digests_of(out)
    assert found.keys() == FILES
    assert result(out)["files"] == {name: found[name] for name in FILES - {"result.json", "log.txt"}}


@pytest.mark.parametrize("error", [NO_SPACE, MemoryError(), ValueError("no ink")])
def test_without_its_page_a_result_keeps_its_numbers_and_the_page_says_so(estimate, out, capsys, error):
    assert estimate("anna", "--quiet") == 0
    assert estimate("bert", draw=refuse(error)) == 0
    assert [warning["code"] for warning in result(out)["warnings"]] == ["report", "example"]  # others' come last
    assert {path.name for path in out.iterdir()} == FILES - {"report-data.npz"}
    assert "bert: report.html could not be drawn" in (out / "report.html").read_text()
    assert main(["report", str(out)]) == 3
    assert "estimate again" in capsys.readouterr().err


def test_files_of_further_pairs_leave_with_the_result_that_lists_them(estimate, out):
    assert estimate("anna", "--quiet") == 0
    (out / "mesh_2.vtu").write_text("anna's")
    document = result(out)
    document["files"]["mesh_2.vtu"] = digests_of(out)["mesh_2.vtu"]
    (out / "result.json").write_text(json.dumps(document))
    (out / "mesh_3.vtu").write_text("somebody's")
    assert estimate("bert", "--quiet") == 0
    assert not (out / "mesh_2.vtu").exists()
    assert (out / "mesh_3.vtu").read_text() == "somebody's"
    assert any("mesh_3.vtu in the output folder" in warning["message"] for warning in result(out)["warnings"])


@pytest.mark.parametrize("name", ["report-data.npz", "result.json"])
def test_a_page_is_drawn_of_no_other_run_than_the_result_tells_of(estimate, out, capsys, name):
    assert estimate("anna", "--quiet") == 0
    before, changed = contents(out), b"\n" if name == "report-data.npz" else b"0"
    (out / name).write_bytes(before[name].replace(b'sha256": "', b'sha256": "' + changed) + b"\n")
    edited = contents(out)
    assert main(["report", str(out)]) == 3
    assert "does not belong to the result beside it" in capsys.readouterr().err
    assert contents(out) == edited
    (out / name).write_bytes(before[name])
    assert main(["report", str(out), "--quiet"]) == 0
    assert result(out)["files"]["report.html"] == digests_of(out)["report.html"]


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT, signal.SIGHUP])
@pytest.mark.parametrize("moment", ["before", "among", "after"])
def test_an_interrupted_run_says_whether_the_files_are_its_own(estimate, out, capfd, number, moment):
    """A signal before any file leaves, when one takes its place, or at the last thing that a run does there."""
    assert estimate("anna", "--quiet") == 0
    before, replace, unlink = contents(out), Path.replace, Path.unlink

    def sent() -> None:
        os.kill(os.getpid(), number)

    def work() -> int:
        if moment == "before":
            return estimate("bert", "--quiet", meanwhile=sent)
        if moment == "among":
            Path.replace = lambda path, place: (sent() if place.parent == out else None, replace(path, place))
        else:
            Path.unlink = lambda path, **options: (sent() if path.name == NAME else None, unlink(path, **options))
        return estimate("bert", "--quiet")

    assert in_a_child(work) == 130
    (line,) = capfd.readouterr().err.strip().splitlines()
    if moment == "before":
        assert "no file was changed" in line
        assert contents(out) == before
    else:
        assert "interrupted after these files were written: " in line
        assert (result(out)["id"], (out / "report.html").read_text()) == ("bert", "the page of bert")


def test_what_a_kill_leaves_is_told_and_does_not_stop_the_next_run(estimate, out, capsys):
    assert estimate("anna", "--quiet") == 0
    before, remove = contents(out), os.unlink

    def work() -> int:
        def unlink(path, **_):
            return os.kill(os.getpid(), signal.SIGKILL) if path.name == "mesh.vtu" else remove(path)

        Path.unlink = unlink
        return estimate("bert", "--quiet")

    assert in_a_child(work) == -signal.SIGKILL
    (aside,) = out.glob(f"{EARLIER}*")
    assert contents(aside) == before
    assert main(["report", str(out)]) == 3
    assert f"a run that was killed left the earlier one: {aside / 'result.json'}" in capsys.readouterr().err
    assert main(["report", str(aside), "--quiet"]) == 0
    assert estimate("bert", "--quiet") == 0
    assert {path.name for path in out.iterdir()} == FILES | {aside.name}
    assert result(out)["warnings"] == [{"code": "example", "message": "a warning to be shown"}]
