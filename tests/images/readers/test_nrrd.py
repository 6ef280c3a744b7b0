"""NRRD: the same image whatever the space, encoding, byte order or file layout; a sentence for each bad header."""

from __future__ import annotations

import bz2
import gzip
from pathlib import Path

import nrrd
import numpy as np
import pytest

from image_files import AFFINE, labels, nrrd_header, read_label_image, voxels, write
from palpate.errors import InputDataError
from palpate.images import readers


@pytest.mark.parametrize("encoding", ["raw", "gzip"])
@pytest.mark.parametrize(
    ("space", "signs"),
    [
        ("right-anterior-superior", (1, 1, 1)),
        ("RAS", (1, 1, 1)),
        ("left-anterior-superior", (-1, 1, 1)),
        ("LAS", (-1, 1, 1)),
        ("left-posterior-superior", (-1, -1, 1)),
        ("LPS", (-1, -1, 1)),
    ],
)
def test_files_of_pynrrd_are_read_in_every_space(
    tmp_path: Path, space: str, signs: tuple[int, ...], encoding: str
) -> None:
    there = np.diag([*signs, 1]) @ AFFINE
    fields = {"space": space, "space directions": there[:3, :3].T, "space origin": there[:3, 3], "encoding": encoding}
    nrrd.write(str(tmp_path / "a.nrrd"), labels(), fields)
    image = read_label_image(tmp_path / "a.nrrd")
    assert np.array_equal(image.labels, labels())
    assert np.array_equal(image.grid.affine, AFFINE)
    assert image.names == {}


@pytest.mark.parametrize(
    ("changes", "data"),
    [
        ({"data_file": "v.raw", "byte_skip": "7"}, b"\1" * 7),
        ({"data_file": "v.raw", "byteskip": "-1"}, b"\1" * 7),
        ({"datafile": "./v.raw", "line_skip": "2"}, b"one\ntwo\n"),
        ({"data_file": "inner/../v.raw", "line_skip": "1", "byte_skip": "3"}, b"one\nabc"),
    ],
)
def test_voxels_in_a_file_beside_the_header_begin_where_it_says(
    tmp_path: Path, changes: dict[str, str], data: bytes
) -> None:
    (tmp_path / "inner").mkdir()
    write(tmp_path / "v.raw", data + voxels())
    path = write(tmp_path / "a.nhdr", nrrd_header(**changes))
    assert np.array_equal(read_label_image(path).labels, labels())


LAYERED = {"dimension": "4", "sizes": "1 4 5 6", "kinds": "list domain domain domain"}
TIMED = {"dimension": "4", "sizes": "4 5 6 1", "kinds": None}
PLAIN = "(0.5,0,0) (0,1,0) (0,0,2.5)"


@pytest.mark.parametrize(
    ("changes", "pack"),
    [
        ({"encoding": "bzip2"}, bz2.compress),
        ({"encoding": "bz2", "byte_skip": "3"}, lambda voxels: bz2.compress(b"abc" + voxels)),
        ({"encoding": "GZIP", "byte_skip": "3"}, lambda voxels: gzip.compress(b"abc" + voxels)),
        ({"encoding": "gz", "line_skip": "1"}, lambda voxels: b"a line\n" + gzip.compress(voxels)),
        ({"encoding": "ascii"}, lambda voxels: " ".join(map(str, voxels)).encode()),
        ({"encoding": "text", "type": "short"}, lambda voxels: "\n".join(map(str, voxels)).encode() + b"\n"),
        ({"space_directions": "(0.5, 0, 0) (0, 1, 0)  (0,0, 2.5 )", "space_origin": "( -20, 7, -3.5)"}, bytes),
        ({**LAYERED, "space_directions": f"none {PLAIN}"}, bytes),
        ({**LAYERED, "space_directions": f"nan {PLAIN}"}, bytes),
        ({**LAYERED, "space_directions": f"(nan,nan,nan) {PLAIN}"}, bytes),
        ({**TIMED, "space_directions": f"{PLAIN} none"}, bytes),
        (
            {
                **TIMED,
                "space": "right-anterior-superior-time",
                "space_directions": "(0.5,0,0,0) (0,1,0,0) (0,0,2.5,0) (0,0,0,3)",
                "space_origin": "(-20,7,-3.5,9)",
                "space_units": '"mm" "mm" "mm" "s"',
            },
            bytes,
        ),
        ({"type": "uchar\nTYPE:   uchar "}, bytes),
        ({"kinds": "domain domain domain\nDICOM_0008:=a\nDICOM_0008:=a\n# sizes: 1 2 3"}, bytes),
        ({"space": "RAS\r", "Content": "colons: and = signs", "Sample_Units": '"HU"'}, bytes),
        ({"thicknesses": "nan nan 2.5", "old_min": "0", "measurement_frame": "(1,0,0) (0,1,0) (0,0,1)"}, bytes),
    ],
)
def test_what_other_programs_write_is_read(tmp_path: Path, changes, pack) -> None:
    image = read_label_image(write(tmp_path / "a.nrrd", nrrd_header(**changes) + pack(voxels())))
    assert np.array_equal(image.labels, labels())
    assert np.array_equal(image.grid.affine, AFFINE)


def test_all_axes_are_there_for_those_who_can_use_them(tmp_path: Path) -> None:
    vectors = np.random.default_rng(4).normal(size=(3, 4, 5, 6)).astype(np.float32)
    changes = {"sizes": "3 4 5 6", "space_directions": f"none {PLAIN}", "kinds": "vector domain domain domain"}
    content = nrrd_header(dimension="4", type="float", endian="big", space_units='"cm" "cm" "cm"', **changes)
    path = write(tmp_path / "a.nrrd", content + vectors.astype(">f4").tobytes(order="F"))
    array, fields = readers.nrrd.nrrd_content(path)
    assert np.array_equal(array.layers(path), vectors)
    np.testing.assert_allclose(array.affine, np.diag([10.0, 10.0, 10.0, 1.0]) @ AFFINE)
    assert fields["kinds"][0] == "vector"
    with pytest.raises(InputDataError, match="three axes"):
        read_label_image(path)


def test_text_that_is_not_exact_in_its_type_is_refused(tmp_path: Path) -> None:
    for word in ("300", "1.5", "x", "nan", ""):
        body = " ".join([word, *["1"] * 119]).encode()
        with pytest.raises(InputDataError, match=r"written as text|cannot hold"):
            read_label_image(write(tmp_path / "a.nrrd", nrrd_header(encoding="ascii") + body))


def test_a_missing_origin_is_zero_and_units_are_honoured(tmp_path: Path) -> None:
    content = nrrd_header(space_origin=None, space_units='"m" "m" "m"') + voxels()
    image = read_label_image(write(tmp_path / "a.nrrd", content))
    np.testing.assert_allclose(image.grid.affine, np.diag([500.0, 1000.0, 2500.0, 1.0]))
