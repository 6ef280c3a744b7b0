"""NRRD: the same image whatever the space, encoding, byte order or file layout; a sentence for each bad header."""

from __future__ import annotations

import bz2
import gzip
from functools import partial
from pathlib import Path

import nrrd
import numpy as np
import pytest
from numpy.typing import NDArray

from palpate.errors import InputDataError
from palpate.images import readers

read_label_image = partial(readers.read_label_image, limits=None)
read_intensities = partial(readers.read_intensities, limits=None)

AFFINE = np.array([[0.5, 0, 0, -20], [0, 1.0, 0, 7], [0, 0, 2.5, -3.5], [0, 0, 0, 1]])
HEADER = {
    "type": "uchar",
    "dimension": "3",
    "space": "right-anterior-superior",
    "sizes": "4 5 6",
    "space directions": "(0.5,0,0) (0,1,0) (0,0,2.5)",
    "kinds": "domain domain domain",
    "encoding": "raw",
    "space origin": "(-20,7,-3.5)",
}


def labels() -> NDArray[np.uint8]:
    return np.random.default_rng(3).integers(0, 5, (4, 5, 6), dtype=np.uint8)


def header(**changes: str | None) -> bytes:
    fields = {**HEADER, **{key.replace("_", " "): value for key, value in changes.items()}}
    lines = [f"{key}: {value}" for key, value in fields.items() if value is not None]
    return "\n".join(["NRRD0004", *lines, "", ""]).encode()


def write(path: Path, content: bytes) -> Path:
    path.write_bytes(content)
    return path


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


@pytest.mark.parametrize("detached", [False, True])
@pytest.mark.parametrize("dtype", ["i1", "u2", "<i4", ">i4", ">f4", "f8", "i8", "u8"])
def test_every_number_type_and_byte_order_gives_the_same_labels(tmp_path: Path, dtype: str, detached: bool) -> None:
    fields = {"space": "RAS", "space directions": AFFINE[:3, :3].T, "space origin": AFFINE[:3, 3]}
    path = tmp_path / ("a.nhdr" if detached else "a.nrrd")
    nrrd.write(str(path), labels().astype(dtype), fields)
    assert np.array_equal(read_label_image(path).labels, labels())
    values, grid = read_intensities(path)
    assert values.dtype == np.float32
    assert np.array_equal(grid.affine, AFFINE)


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
    write(tmp_path / "v.raw", data + labels().tobytes(order="F"))
    path = write(tmp_path / "a.nhdr", header(**changes))
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
    image = read_label_image(write(tmp_path / "a.nrrd", header(**changes) + pack(labels().tobytes(order="F"))))
    assert np.array_equal(image.labels, labels())
    assert np.array_equal(image.grid.affine, AFFINE)


def test_all_axes_are_there_for_those_who_can_use_them(tmp_path: Path) -> None:
    vectors = np.random.default_rng(4).normal(size=(3, 4, 5, 6)).astype(np.float32)
    changes = {"sizes": "3 4 5 6", "space_directions": f"none {PLAIN}", "kinds": "vector domain domain domain"}
    content = header(dimension="4", type="float", endian="big", space_units='"cm" "cm" "cm"', **changes)
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
            read_label_image(write(tmp_path / "a.nrrd", header(encoding="ascii") + body))


def test_a_missing_origin_is_zero_and_units_are_honoured(tmp_path: Path) -> None:
    content = header(space_origin=None, space_units='"m" "m" "m"') + labels().tobytes(order="F")
    image = read_label_image(write(tmp_path / "a.nrrd", content))
    np.testing.assert_allclose(image.grid.affine, np.diag([500.0, 1000.0, 2500.0, 1.0]))


def test_a_list_axis_of_one_is_dropped(tmp_path: Path) -> None:
    directions = f"none {HEADER['space directions']}"
    content = header(dimension="4", sizes="1 4 5 6", space_directions=directions, kinds=None)
    image = read_label_image(write(tmp_path / "a.nrrd", content + labels().tobytes(order="F")))
    assert np.array_equal(image.labels, labels())


def test_data_outside_the_folder_are_not_followed(tmp_path: Path) -> None:
    folder = tmp_path / "case"
    (folder / "inner").mkdir(parents=True)
    secret = write(tmp_path / "secret.raw", labels().tobytes(order="F"))
    (folder / "link.raw").symlink_to(secret)
    (folder / "loop.raw").symlink_to(folder / "loop.raw")
    (folder / "inner" / "up").symlink_to(tmp_path)
    outside = ["../secret.raw", str(secret), "link.raw", "inner/up/secret.raw", "inner/../../secret.raw"]
    for name in outside:
        path = write(folder / "a.nhdr", header(data_file=name))
        with pytest.raises(InputDataError, match="outside its own folder"):
            read_label_image(path)
    for name in ("missing.raw", "inner", "loop.raw", "x" * 300, "a\0b"):
        with pytest.raises(InputDataError, match="no such file"):
            read_label_image(write(folder / "a.nhdr", header(data_file=name)))
    for name in ("LIST", "slice%03d.raw 1 6 1"):
        with pytest.raises(InputDataError, match="several files"):
            read_label_image(write(folder / "a.nhdr", header(data_file=name)))
    write(folder / "voxels.raw", labels().tobytes(order="F"))
    (folder / "inner" / "a.raw").symlink_to(folder / "voxels.raw")
    path = write(folder / "a.nhdr", header(data_file="inner/a.raw"))
    assert np.array_equal(read_label_image(path).labels, labels())


BAD_HEADERS = {
    "no mark": (b"NRRD0009\n" + header()[9:], "does not begin"),
    "not a field": (header()[:-1] + b"nonsense\n\n", "no NRRD header"),
    "field twice": (header()[:-1] + b"sizes: 1 2 3\n\n", "Duplicate header field: sizes"),
    "key twice": (header()[:-1] + b"Segment0_Name:=a\nSegment0_Name:=b\n\n", "Duplicate header field: Segment0_Name"),
    "no sizes": (header(sizes=None), "sizes: missing"),
    "no type": (header(type=None), "type: missing"),
    "no encoding": (header(encoding=None), "encoding: missing"),
    "zero size": (header(sizes="4 0 6"), "positive counts"),
    "negative size": (header(sizes="4 -5 6"), "positive counts"),
    "size no number": (header(sizes="4 x 6"), "no NRRD header"),
    "size not plain": (header(sizes="4 ² 6"), "plain digits"),
    "size no count": (header(sizes="4 0.5 6"), "positive counts"),
    "huge": (header(sizes="99999 99999 99999"), "more than the"),
    "overflow": (header(sizes="4294967296 4294967296 4294967296"), "more than the"),
    "sizes not data": (header(sizes="4 5 60"), "cannot hold"),
    "dimension": (header(dimension="2"), "2 positive counts"),
    "two axes": (header(dimension="2", sizes="4 5", space_directions="(1,0,0) (0,1,0)"), "three axes"),
    "four axes": (
        header(dimension="4", sizes="2 2 5 6", space_directions="none (1,0,0) (0,1,0) (0,0,1)"),
        "three axes",
    ),
    "type": (header(type="block"), "type"),
    "encoding": (header(encoding="zip"), "encoding: zip"),
    "no bzip2": (header(encoding="bzip2"), "damaged"),
    "no text": (header(encoding="ascii"), "cannot hold"),
    "endian": (header(type="short"), "endian"),
    "no space": (header(space=None), "right, front and head"),
    "other space": (header(space="scanner-xyz"), "right, front and head"),
    "no directions": (header(space_directions=None, spacings="1 1 1"), "right, front and head"),
    "NaN": (header(space_directions="(nan,0,0) (0,1,0) (0,0,1)"), "not finite"),
    "infinite": (header(space_origin="(inf,0,0)"), "not finite"),
    "short origin": (header(space_origin="(1,0)"), "vectors of 3 numbers"),
    "time leans": (
        header(
            dimension="4",
            sizes="4 5 6 1",
            space="LPST",
            space_directions="(1,0,0,1) (0,1,0,0) (0,0,1,0) (0,0,0,1)",
            space_origin="(0,0,0,0)",
        ),
        "three axes",
    ),
    "too large": (header(space_directions="(1e300,0,0) (0,1e300,0) (0,0,1)"), "flattens"),
    "flat": (header(space_directions="(1,0,0) (1,0,0) (0,0,1)"), "flattens"),
    "zero": (header(space_directions="(0,0,0) (0,1,0) (0,0,1)"), "flattens"),
    "units": (header(space_units='"mm" "mm" "inch"'), "space units"),
    "skip": (header(byte_skip="999999999999"), "999999999999 bytes before"),
    "skip back": (header(encoding="gzip", byte_skip="-1"), "-1 bytes before"),
    "skip behind": (header(byte_skip="-2"), "-2 bytes before"),
    "lines": (header(line_skip="1e9"), "no NRRD header"),
    "many lines": (header(line_skip="1000000000"), "line skip"),
    "long line": (header()[:-1] + b"#" + b"x" * 70_000 + b"\n\n", "does not end"),
    "endless": (header()[:-1] + (b"#" + b"x" * 60_000 + b"\n") * 80, "does not end"),
    "no gzip": (header(encoding="gzip"), "damaged"),
    "control": (header(space="\x1b[2Jx"), "right, front and head"),
}


@pytest.mark.parametrize("name", BAD_HEADERS)
def test_a_bad_header_is_refused_with_its_reason(tmp_path: Path, name: str) -> None:
    content, words = BAD_HEADERS[name]
    path = write(tmp_path / "a.nrrd", content + labels().tobytes(order="F"))
    with pytest.raises(InputDataError, match=words) as caught:
        read_label_image(path)
    assert str(path) in str(caught.value)
    assert str(caught.value).isprintable()


def test_a_cut_or_endless_stream_is_refused(tmp_path: Path) -> None:
    packed = gzip.compress(labels().tobytes(order="F"))
    head = header(encoding="gzip")
    for body, words in ((packed[:-20], "damaged|cut short"), (packed[:-8] + b"\0" * 8, "damaged")):
        with pytest.raises(InputDataError, match=words):
            read_label_image(write(tmp_path / "a.nrrd", head + body))
    bomb = gzip.compress(labels().tobytes(order="F") + bytes(50_000_000))
    with pytest.raises(InputDataError, match="has more than"):
        read_label_image(write(tmp_path / "a.nrrd", head + bomb))
    with pytest.raises(InputDataError, match="cannot hold"):
        read_label_image(write(tmp_path / "a.nrrd", header(encoding="gzip", sizes="800 800 800") + packed))
