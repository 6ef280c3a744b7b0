"""Files are opened without waiting and digested as they are read."""

from __future__ import annotations

import hashlib
import os
import re
from pathlib import Path

import numpy as np
import pytest

from palpate.errors import InputDataError
from palpate.images.input_file import open_input, read_input, similar_names
from palpate.images.label_image import VoxelGrid
from palpate.images.readers import read_intensities, write_scalar_image

CONTENT = np.random.default_rng(1).bytes(3_000_000)
DIGEST = hashlib.sha256(CONTENT).hexdigest()

READINGS = {
    "nothing": lambda file: file.peek(),
    "all at once": lambda file: file.read(),
    "lines": lambda file: [file.readline() for _ in range(5)],
    "here and there": lambda file: [file.peek(9), file.read(70_000), file.readline(), file.read(1_000_000)],
    "the rest": lambda file: [file.readline(), file.read()],
}


@pytest.mark.parametrize(
    ("mistyped", "meant"),
    [
        ("caes/before.nii.gz", "case/before.nii.gz"),
        ("case/befor.nii.gz", "case/before.nii.gz"),
        ("caes/befor.nii.gz", "case"),
        ("csae", "case"),
        ("case/quite_another_name", None),
        ("case", None),
    ],
)
def test_a_mistyped_path_gets_the_one_that_is_like_it(mistyped, meant, tmp_path: Path) -> None:
    (tmp_path / "case").mkdir()
    (tmp_path / "case" / "before.nii.gz").write_bytes(CONTENT)
    hint = similar_names(tmp_path / mistyped)
    assert hint == ("" if meant is None else f", did you mean '{tmp_path / meant}'?")
    if "/" in mistyped:
        with pytest.raises(FileNotFoundError) as caught:
            open_input(tmp_path / mistyped)
        assert caught.value.strerror == f"there is no such file{hint}"


@pytest.mark.parametrize("name", READINGS)
def test_the_digest_is_that_of_the_whole_file_however_it_was_read(name, tmp_path: Path) -> None:
    (tmp_path / "a").write_bytes(CONTENT)
    with open_input(tmp_path / "a") as file:
        READINGS[name](file)
        place = file.tell()
        assert file.peek(9)[:9] == CONTENT[place : place + 9]
        assert file.sha256() == DIGEST


def test_what_was_passed_over_cannot_be_left_out_of_the_digest(tmp_path: Path) -> None:
    (tmp_path / "a").write_bytes(CONTENT)
    with open_input(tmp_path / "a") as file, pytest.raises(OSError, match="not seekable"):
        file.seek(5)


def test_the_digest_is_of_the_bytes_that_were_read_though_the_file_changes(tmp_path: Path) -> None:
    (tmp_path / "a").write_bytes(CONTENT)
    with open_input(tmp_path / "a") as file:
        assert file.read() == CONTENT
        (tmp_path / "a").write_bytes(CONTENT[::-1])
        assert file.sha256() == DIGEST


def test_no_more_is_read_than_the_limit_and_a_byte(tmp_path: Path) -> None:
    (tmp_path / "a").write_bytes(CONTENT)
    assert read_input(tmp_path / "a", 100) == (CONTENT[:101], hashlib.sha256(CONTENT[:101]).hexdigest())
    assert read_input(tmp_path / "a", 3_000_000) == (CONTENT, DIGEST)


def test_what_is_no_regular_file_is_refused_at_once(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe")
    for path in (tmp_path / "pipe", tmp_path, Path("/dev/zero")):
        with pytest.raises(OSError, match="not a file"):
            open_input(path)


def test_of_a_folder_with_a_case_the_case_is_meant(tmp_path: Path) -> None:
    (tmp_path / "case.toml").write_text("")
    with pytest.raises(OSError, match=re.escape(f"did you mean '{tmp_path / 'case.toml'}'?")):
        open_input(tmp_path)


def test_a_grey_image_that_changed_since_the_run_began_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "a.nii"
    write_scalar_image(path, np.zeros((3, 4, 5)), VoxelGrid((3, 4, 5), np.eye(4)))
    digest = hashlib.sha256(path.read_bytes()).hexdigest()
    assert read_intensities(path, sha256=digest)[0].shape == (3, 4, 5)
    write_scalar_image(path, np.ones((3, 4, 5)), VoxelGrid((3, 4, 5), np.eye(4)))
    with pytest.raises(InputDataError, match="changed after this run began"):
        read_intensities(path, sha256=digest)
