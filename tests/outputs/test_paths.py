"""Names and places of outputs: what cannot be written is refused with 6 and a sentence, what can leads to its place."""

from __future__ import annotations

import dataclasses
import os
import subprocess
import sys
from contextlib import chdir
from pathlib import Path

import numpy as np
import pytest

from palpate.cli import main
from palpate.errors import ResourceError
from palpate.export.case_files import file_name, write_mesh_files
from palpate.images.label_image import LabelImage, VoxelGrid
from palpate.images.readers import write_label_image
from palpate.steps.previewing import new_case_with_page
from palpate.study.case_file import read_case
from palpate.study.outputs import OutputFolder, staged
from palpate.study.result import MeshResult


def ball(place: float) -> LabelImage:
    places = np.stack(np.meshgrid(*[np.arange(16.0)] * 3, indexing="ij"), axis=-1)
    return LabelImage((np.linalg.norm(places - place, axis=-1) < 4).astype(int), VoxelGrid((16, 16, 16), np.eye(4)))


@pytest.fixture
def images(tmp_path):
    """The working folder with the two images that `init` needs."""
    for name, place in (("before", 7.0), ("after", 8.0)):
        write_label_image(tmp_path / f"{name}.nii.gz", ball(place))
    with chdir(tmp_path):
        yield ["before.nii.gz", "after.nii.gz"]


def sentence(capsys) -> str:
    (line,) = capsys.readouterr().err.strip().splitlines()
    assert "bug" not in line
    return line


@pytest.mark.parametrize("name", ["n" * 256, "n/" * 3000, f"below/{'m' * 300}/out"])
@pytest.mark.parametrize("flags", [["--json"], ["--quiet"]])
def test_a_folder_whose_name_is_too_long_ends_with_6(estimate, tmp_path, capsys, name, flags):
    assert estimate("anna", "--output", str(tmp_path / name), *flags) == 6
    assert "File name too long" in sentence(capsys)


AS_NOBODY = """
import os, sys
from palpate.cli import main
import palpate.cli.entry, palpate.steps.display, palpate.study.new_case, palpate.study.case_file, scipy.linalg
os.getuid() or os.setuid(65534)
sys.exit(main(sys.argv[1:]))
"""


def test_a_parent_that_may_not_be_searched_ends_with_6(images, tmp_path):
    (tmp_path / "closed" / "out").mkdir(parents=True)
    (tmp_path / "closed").chmod(0o600)
    command = [sys.executable, "-c", AS_NOBODY, "init", *images, "--output", "closed/out", "--quiet"]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 6, done.stderr
    assert "Permission denied" in done.stderr
    assert "Traceback" not in done.stderr


def test_a_case_written_through_a_link_leads_to_its_images(images, tmp_path):
    (tmp_path / "deep" / "er").mkdir(parents=True)
    (tmp_path / "link").symlink_to(tmp_path / "deep" / "er")
    assert main(["init", *images, "--output", "link", "--quiet"]) == 0
    assert read_case(tmp_path / "deep" / "er" / "case.toml").images.before.resolve() == tmp_path / "before.nii.gz"


@pytest.mark.usefixtures("images")
def test_names_that_begin_as_homes_do_are_no_homes(tmp_path):
    (tmp_path / "~root").mkdir()
    for name in ("~before.nii.gz", "~root/after.nii.gz"):
        write_label_image(tmp_path / name, ball(7.0 if "before" in name else 8.0))
    for folder in (".", "~root", "~new/~one"):
        assert main(["init", "~before.nii.gz", "~root/after.nii.gz", "--output", folder, "--quiet"]) == 0
        found = read_case(tmp_path / folder / "case.toml").images
        assert found.before.samefile(tmp_path / "~before.nii.gz")
        assert found.after[0].samefile(tmp_path / "~root" / "after.nii.gz")


@pytest.mark.parametrize("kind", ["folder", "link", "pipe"])
def test_a_case_file_that_is_none_is_not_replaced(images, tmp_path, capsys, kind):
    (tmp_path / "out").mkdir()
    place = tmp_path / "out" / "case.toml"
    {"folder": Path.mkdir, "link": lambda path: path.symlink_to(tmp_path / "mine"), "pipe": os.mkfifo}[kind](place)
    assert main(["init", *images, "--output", "out", "--quiet"]) == 6
    assert "out/case.toml is no regular file" in sentence(capsys)
    assert not (tmp_path / "mine").exists()


@pytest.mark.parametrize("kind", ["file", "pipe"])
def test_where_a_sub_folder_is_none_nothing_changes(tmp_path, kind):
    (tmp_path / "notes.txt").write_text("an earlier run's")
    {"file": Path.touch, "pipe": os.mkfifo}[kind](tmp_path / "surfaces")
    with staged(tmp_path) as staging:
        (staging.area / "surfaces").mkdir()
        (staging.area / "surfaces" / "bladder.stl").write_text("new")
        (staging.area / "notes.txt").write_text("new")
        with pytest.raises(ResourceError, match="surfaces is no folder"):
            staging.commit()
    assert sorted(path.name for path in tmp_path.iterdir()) == ["notes.txt", "surfaces"]
    assert (tmp_path / "notes.txt").read_text() == "an earlier run's"


class FullAfterTheCase(OutputFolder):
    """A folder on a disk that has room for one file."""

    def staged(self):
        if self.written:
            raise ResourceError("no space left")
        return super().staged()


def test_a_case_without_room_for_its_preview_stands_and_says_so(images, tmp_path):
    files = [tmp_path / name for name in images]
    with pytest.raises(ResourceError, match=r"case\.toml is written, but not what shows it: no space left"):
        new_case_with_page(files, None, FullAfterTheCase(tmp_path / "out"))
    assert [path.name for path in (tmp_path / "out").iterdir()] == ["case.toml"]


@pytest.mark.parametrize("letter", ["a", "ä", "前", "𝒜", "/", "\udc80"])
def test_file_names_made_of_tissues_have_bytes_to_spare(tmp_path, letter):
    name = file_name(600 * letter)
    assert 0 < len(name.encode()) <= 60
    (tmp_path / f"00_{name}_before.vtp").touch()


def test_a_tissue_of_sixty_letters_of_four_bytes_has_its_surface(tmp_path, case_result):
    mesh = case_result.space.mesh
    named = dataclasses.replace(mesh, tissues=(dataclasses.replace(mesh.tissues[0], name=60 * "𝒜"), *mesh.tissues[1:]))
    space = dataclasses.replace(case_result.space, mesh=named)
    made = MeshResult(case_result.case, space, case_result.mesh_summary, case_result.before, case_result.provenance)
    write_mesh_files(made, tmp_path)
    assert [path.name for path in (tmp_path / "surfaces").glob("00_*")] == [f"00_{15 * '𝒜'}_before.vtp"]


def test_modules_of_the_working_folder_are_not_run(tmp_path):
    for name in ("numpy", "argparse", "scipy", "logging", "json", "pathlib", "typing", "dataclasses"):
        (tmp_path / f"{name}.py").write_text("raise SystemExit('the working folder was searched')\n")
    command = [sys.executable, "-m", "palpate", "check", "nowhere.toml"]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert done.returncode == 2, done.stderr
    assert "nowhere.toml" in done.stdout + done.stderr
