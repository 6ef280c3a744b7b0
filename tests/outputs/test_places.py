"""Nothing is written outside of the output folder; what cannot be written there is refused before it is computed."""

from __future__ import annotations

import errno
import fcntl
import os
import subprocess
import sys
from contextlib import chdir
from pathlib import Path

import numpy as np
import pytest

from case_texts import ORGAN, REST, case_text
from children import in_a_child
from palpate.case.file import read_case
from palpate.cli import main
from palpate.errors import ResourceError
from palpate.export.case_files import file_name
from palpate.images.label_image import LabelImage, VoxelGrid
from palpate.images.readers import write_label_image
from palpate.steps.previewing import new_case_with_page
from palpate.study.outputs import OutputFolder

MINE = ("link", "dangling link", "hard link", "pipe", "folder")


def lay(kind: str, path: Path, other: Path) -> None:
    """What a file cannot replace, under its name; `other` lies outside of the folder."""
    if kind == "dangling link":
        other = other.with_name("nowhere")
    {
        "link": lambda: path.symlink_to(other),
        "dangling link": lambda: path.symlink_to(other),
        "hard link": lambda: path.hardlink_to(other),
        "pipe": lambda: os.mkfifo(path),
        "folder": path.mkdir,
        "file": path.touch,
    }[kind]()


def sentence(capsys) -> str:
    (line,) = capsys.readouterr().err.strip().splitlines()
    assert "bug" not in line
    return line


@pytest.mark.parametrize("kind", MINE)
@pytest.mark.parametrize("name", [".palpate.lock", "log.txt", "result.json", "case.toml", "mesh.vtu"])
def test_lock_log_and_outputs_are_regular_files_or_the_run_is_refused_at_once(
    estimate, out, tmp_path, capsys, name, kind
):
    if kind == "hard link" and name.endswith((".json", ".toml", ".vtu")):
        pytest.skip("it is replaced, and the other name keeps what it had")
    out.mkdir()
    (tmp_path / "other").write_text("mine")
    lay(kind, out / name, tmp_path / "other")
    assert estimate("anna", "--quiet", meanwhile=lambda: pytest.fail("it computes")) in (2, 6)
    assert str(out / name) in sentence(capsys)
    assert (tmp_path / "other").read_text() == "mine"
    assert {path.name for path in out.iterdir()} - {"log.txt"} == {name} - {"log.txt"}
    assert not (tmp_path / "nowhere").exists()


@pytest.mark.parametrize("kind", ["link", "pipe", "file"])
def test_the_hidden_folder_is_one_or_the_run_is_refused(estimate, out, tmp_path, capsys, kind):
    out.mkdir()
    (tmp_path / "other").mkdir()
    (tmp_path / "other" / "mine").write_text("mine")
    lay(kind, out / ".writing-outputs", tmp_path / "other")
    assert estimate("anna", "--quiet") == 6
    assert ".writing-outputs is no folder of Palpate's" in sentence(capsys)
    assert [path.name for path in (tmp_path / "other").iterdir()] == ["mine"]


@pytest.mark.parametrize("kind", ["link", "pipe", "file"])
def test_a_sub_folder_is_one_or_nothing_changes(tmp_path, kind):
    out, other = tmp_path / "out", tmp_path / "other"
    out.mkdir()
    other.mkdir()
    (out / "notes.txt").write_text("earlier")
    lay(kind, out / "surfaces", other)

    def write() -> None:
        with OutputFolder(out).new_files() as area:
            (area / "surfaces").mkdir()
            (area / "surfaces" / "bladder.stl").write_text("new")
            (area / "notes.txt").write_text("new")

    with pytest.raises(ResourceError, match="through a link" if kind == "link" else "surfaces is no folder"):
        write()
    assert (out / "notes.txt").read_text() == "earlier"
    assert sorted(path.name for path in out.iterdir()) == ["notes.txt", "surfaces"]
    assert list(other.iterdir()) == []


def test_a_file_system_without_locks_is_warned_of_and_works(estimate, out, capfd):
    def unknown(*_):
        raise OSError(errno.ENOSYS, "Function not implemented")

    def work() -> int:
        fcntl.flock = unknown
        return estimate("anna", "--quiet")

    assert in_a_child(work) == 0
    assert "knows no locks" in capfd.readouterr().err
    assert (out / "result.json").exists()


@pytest.mark.parametrize("name", ["n" * 256, "n/" * 3000, f"below/{'m' * 300}/out"])
def test_a_folder_whose_name_is_too_long_ends_with_6(estimate, tmp_path, capsys, name):
    assert estimate("anna", "--output", str(tmp_path / name), "--quiet") == 6
    assert "File name too long" in sentence(capsys)


def ball(place: float) -> LabelImage:
    places = np.stack(np.meshgrid(*[np.arange(16.0)] * 3, indexing="ij"), axis=-1)
    return LabelImage((np.linalg.norm(places - place, axis=-1) < 4).astype(int), VoxelGrid((16, 16, 16), np.eye(4)))


@pytest.fixture
def images(tmp_path):
    """The working folder with the two images that `init` needs, whose names begin as homes do."""
    (tmp_path / "~root").mkdir()
    for name, place in (("~before.nii.gz", 7.0), ("~root/after.nii.gz", 8.0)):
        write_label_image(tmp_path / name, ball(place))
    with chdir(tmp_path):
        yield ["~before.nii.gz", "~root/after.nii.gz"]


def test_a_case_leads_to_its_images_from_wherever_it_lies(images, tmp_path):
    (tmp_path / "deep" / "er").mkdir(parents=True)
    (tmp_path / "link").symlink_to(tmp_path / "deep" / "er")
    for folder in (".", "~root", "~new/~one", "link"):
        assert main(["init", *images, "--output", folder, "--quiet"]) == 0
        found = read_case((tmp_path / folder / "case.toml").resolve()).images
        assert found.before.samefile(tmp_path / images[0])
        assert found.after[0].samefile(tmp_path / images[1])


AS_NOBODY = """
import os, sys
from palpate.cli import main
import palpate.cli.entry, palpate.steps.display, palpate.study.new_case, palpate.case.file, scipy.linalg
os.getuid() or os.setuid(65534)
sys.exit(main(sys.argv[1:]))
"""


def test_a_parent_that_may_not_be_searched_ends_with_6(images, tmp_path):
    (tmp_path / "closed" / "out").mkdir(parents=True)
    (tmp_path / "closed").chmod(0o600)
    command = [sys.executable, "-c", AS_NOBODY, "init", *images, "--output", "closed/out", "--quiet"]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert (done.returncode, "Traceback" in done.stderr) == (6, False), done.stderr
    assert "Permission denied" in done.stderr


def test_an_output_never_replaces_an_input(tmp_path, capsys):
    for name, place in (("before", 7.0), ("after", 8.0)):
        write_label_image(tmp_path / f"{name}.nii.gz", ball(place))
    (tmp_path / "case.toml").write_text(case_text({"a": ORGAN | {"youngs_modulus_kpa": 3.0}, "b": REST}))
    before = {path.name: path.read_bytes() for path in tmp_path.iterdir()}
    assert main(["simulate", str(tmp_path / "case.toml"), "--output", str(tmp_path), "--quiet"]) == 2
    assert "before.nii.gz is an input of this run" in sentence(capsys)
    assert {path.name: path.read_bytes() for path in tmp_path.iterdir()} == before


class FullAfterTheCase(OutputFolder):
    """A folder on a disk that has room for one file."""

    def new_files(self):
        if self.written:
            raise ResourceError("no space left")
        return super().new_files()


def test_a_case_without_room_for_its_preview_stands_and_says_so(images, tmp_path):
    with pytest.raises(ResourceError, match=r"case\.toml is written, but not what shows it: no space left"):
        new_case_with_page([Path(name) for name in images], None, FullAfterTheCase(tmp_path / "out"))
    assert [path.name for path in (tmp_path / "out").iterdir()] == ["case.toml"]


@pytest.mark.parametrize("letter", ["a", "ä", "前", "𝒜", "/", "\udc80"])
def test_file_names_made_of_tissues_have_bytes_to_spare(tmp_path, letter):
    name = file_name(600 * letter)
    assert 0 < len(name.encode()) <= 60
    (tmp_path / f"00_{name}_before.vtp").touch()
