"""What holds in every format: the same image from each way of storing it; a sentence for each file that is none."""

from __future__ import annotations

import gzip
import struct
import tracemalloc
from collections.abc import Callable
from pathlib import Path

import nibabel
import nrrd
import numpy as np
import pytest
import SimpleITK

from image_files import (
    AFFINE,
    PACKED,
    labels,
    metaimage_header,
    nifti,
    nrrd_header,
    read_intensities,
    read_label_image,
    voxels,
    write,
)
from palpate.errors import InputDataError
from palpate.images.readers.registry import format_of


def by_nibabel(path: Path, kind: np.dtype) -> None:
    header = nibabel.Nifti1Header(endianness=">" if kind.byteorder == ">" else "<")
    header.set_data_dtype(kind)
    nibabel.save(nibabel.Nifti1Image(labels().astype(kind), AFFINE, header=header, dtype=kind), path)


def by_pynrrd(path: Path, kind: np.dtype) -> None:
    fields = {"space": "RAS", "space directions": AFFINE[:3, :3].T, "space origin": AFFINE[:3, 3]}
    nrrd.write(str(path), labels().astype(kind), fields)


def by_itk(path: Path, kind: np.dtype) -> None:
    image = SimpleITK.GetImageFromArray(labels().astype(kind.newbyteorder("=")).T)
    image.SetDirection((-1, 0, 0, 0, -1, 0, 0, 0, 1))
    image.SetSpacing(np.diag(AFFINE)[:3])
    image.SetOrigin(AFFINE[:3, 3] * [-1, -1, 1])
    SimpleITK.WriteImage(image, str(path), True)


WRITERS = {"a.nii.gz": by_nibabel, "a.nrrd": by_pynrrd, "a.nhdr": by_pynrrd, "a.mha": by_itk}


@pytest.mark.parametrize("dtype", ["i1", "u2", "<i4", ">i4", ">f4", "f8", "i8", "u8"])
@pytest.mark.parametrize("name", WRITERS)
def test_every_number_type_and_byte_order_gives_the_same_image(tmp_path: Path, name: str, dtype: str) -> None:
    WRITERS[name](tmp_path / name, np.dtype(dtype))
    image = read_label_image(tmp_path / name)
    assert np.array_equal(image.labels, labels())
    np.testing.assert_allclose(image.grid.affine, AFFINE)
    values, grid = read_intensities(tmp_path / name)
    assert values.dtype == np.float32
    assert np.array_equal(values, labels())
    assert np.array_equal(grid.affine, image.grid.affine)


def put(form: str, offset: int, *numbers: float) -> Callable[[bytearray], None]:
    return lambda content: struct.pack_into(form, content, offset, *numbers)


BAD_NIFTI = {
    "negative size": (put("<h", 42, -1), "positive counts"),
    "zero size": (put("<h", 46, 0), "positive counts"),
    "no axes": (put("<h", 40, 0), "positive counts|begin"),
    "too many axes": (put("<h", 40, 9), "positive counts"),
    "a huge array": (put("<3h", 42, 32767, 32767, 32767), "more than"),
    "more than the file": (put("<3h", 42, 600, 600, 600), "cannot hold|cut short"),
    "unknown type": (put("<h", 70, 77), "damaged"),
    "offset NaN": (put("<f", 108, np.nan), "first voxel"),
    "offset too low": (put("<f", 108, 100.0), "first voxel"),
    "offset negative": (put("<f", 108, -352.0), "first voxel"),
    "offset beyond the file": (put("<f", 108, 1e9), "first voxel"),
    "intercept NaN": (put("<ff", 112, 1.0, np.nan), "damaged"),
    "no orientation": (put("<hh", 252, 0, 0), "neither sform nor qform"),
    "sform NaN": (put("<f", 280, np.nan), "not finite"),
    "sform infinite": (put("<f", 284, np.inf), "not finite"),
    "sform signalling NaN": (put("<I", 284, 0x7F800001), "not finite"),
    "sform singular": (put("<4f", 280, 0.0, 0.0, 0.0, 0.0), "flattens"),
    "sform sheared": (put("<4f", 280, 0.5, 0.3, 0.0, 0.0), "right angles"),
    "unit unknown": (put("<B", 123, 7), "unit of length"),
    "a pair's mark": (put("<4s", 344, b"ni1\0"), "in one piece"),
    "no NIfTI": (put("<i", 0, 347), "does not begin"),
}
BAD_NRRD = {
    "no mark": (b"NRRD0009\n" + nrrd_header()[9:], "does not begin"),
    "not a field": (nrrd_header()[:-1] + b"nonsense\n\n", "no NRRD header"),
    "field twice": (nrrd_header()[:-1] + b"sizes: 1 2 3\n\n", "Duplicate header field: sizes"),
    "key twice": (
        nrrd_header()[:-1] + b"Segment0_Name:=a\nSegment0_Name:=b\n\n",
        "Duplicate header field: Segment0_Name",
    ),
    "no sizes": (nrrd_header(sizes=None), "sizes: missing"),
    "no type": (nrrd_header(type=None), "type: missing"),
    "no encoding": (nrrd_header(encoding=None), "encoding: missing"),
    "zero size": (nrrd_header(sizes="4 0 6"), "positive counts"),
    "negative size": (nrrd_header(sizes="4 -5 6"), "positive counts"),
    "size no number": (nrrd_header(sizes="4 x 6"), "no NRRD header"),
    "size not plain": (nrrd_header(sizes="4 ² 6"), "plain digits"),
    "size no count": (nrrd_header(sizes="4 0.5 6"), "positive counts"),
    "huge": (nrrd_header(sizes="99999 99999 99999"), "more than the"),
    "overflow": (nrrd_header(sizes="4294967296 4294967296 4294967296"), "more than the"),
    "sizes not data": (nrrd_header(sizes="4 5 60"), "cannot hold"),
    "dimension": (nrrd_header(dimension="2"), "2 positive counts"),
    "two axes": (nrrd_header(dimension="2", sizes="4 5", space_directions="(1,0,0) (0,1,0)"), "three axes"),
    "four axes": (
        nrrd_header(dimension="4", sizes="2 2 5 6", space_directions="none (1,0,0) (0,1,0) (0,0,1)"),
        "three axes",
    ),
    "type": (nrrd_header(type="block"), "type"),
    "encoding": (nrrd_header(encoding="zip"), "encoding: zip"),
    "no bzip2": (nrrd_header(encoding="bzip2"), "damaged"),
    "no text": (nrrd_header(encoding="ascii"), "cannot hold"),
    "endian": (nrrd_header(type="short"), "endian"),
    "no space": (nrrd_header(space=None), "right, front and head"),
    "other space": (nrrd_header(space="scanner-xyz"), "right, front and head"),
    "no directions": (nrrd_header(space_directions=None, spacings="1 1 1"), "right, front and head"),
    "NaN": (nrrd_header(space_directions="(nan,0,0) (0,1,0) (0,0,1)"), "not finite"),
    "infinite": (nrrd_header(space_origin="(inf,0,0)"), "not finite"),
    "short origin": (nrrd_header(space_origin="(1,0)"), "vectors of 3 numbers"),
    "time leans": (
        nrrd_header(
            dimension="4",
            sizes="4 5 6 1",
            space="LPST",
            space_directions="(1,0,0,1) (0,1,0,0) (0,0,1,0) (0,0,0,1)",
            space_origin="(0,0,0,0)",
        ),
        "three axes",
    ),
    "too large": (nrrd_header(space_directions="(1e300,0,0) (0,1e300,0) (0,0,1)"), "flattens"),
    "flat": (nrrd_header(space_directions="(1,0,0) (1,0,0) (0,0,1)"), "flattens"),
    "zero": (nrrd_header(space_directions="(0,0,0) (0,1,0) (0,0,1)"), "flattens"),
    "units": (nrrd_header(space_units='"mm" "mm" "inch"'), "space units"),
    "skip": (nrrd_header(byte_skip="999999999999"), "999999999999 bytes before"),
    "skip back": (nrrd_header(encoding="gzip", byte_skip="-1"), "-1 bytes before"),
    "skip behind": (nrrd_header(byte_skip="-2"), "-2 bytes before"),
    "lines": (nrrd_header(line_skip="1e9"), "no NRRD header"),
    "many lines": (nrrd_header(line_skip="1000000000"), "line skip"),
    "long line": (nrrd_header()[:-1] + b"#" + b"x" * 70_000 + b"\n\n", "does not end"),
    "endless": (nrrd_header()[:-1] + (b"#" + b"x" * 60_000 + b"\n") * 80, "does not end"),
    "no gzip": (nrrd_header(encoding="gzip"), "damaged"),
    "control": (nrrd_header(space="\x1b[2Jx"), "right, front and head"),
}
BAD_METAIMAGE = {
    "no MetaImage": (b"\x89PNG\r\n\x1a\n", "does not begin"),
    "no data": (b"ObjectType = Image\n", "does not begin"),
    "twice": (b"NDims = 2\n" + metaimage_header(), "twice"),
    "two places": (metaimage_header(Position="1 2 3"), "twice"),
    "units": (metaimage_header(DistanceUnits="m"), "lengths in mm"),
    "two channels": (metaimage_header(ElementNumberOfChannels="2", DimSize="4 5 3"), "one channel"),
    "two times": (
        metaimage_header(
            NDims="4",
            DimSize="2 5 6 2",
            TransformMatrix="1 0 0 0 0 1 0 0 0 0 1 0 0 0 0 1",
            Offset="0 0 0 0",
            ElementSpacing="1 1 1 1",
        ),
        "one channel",
    ),
    "no sizes": (metaimage_header(DimSize=None), "DimSize: missing"),
    "size no number": (metaimage_header(DimSize="4 ² 6"), "positive counts"),
    "zero size": (metaimage_header(DimSize="4 0 6"), "positive counts"),
    "huge": (metaimage_header(DimSize="99999 99999 99999"), "more than the"),
    "sizes not data": (metaimage_header(DimSize="4 5 60"), "cannot hold"),
    "disagree": (metaimage_header(NDims="2"), "DimSize has 3"),
    "two axes": (metaimage_header(NDims="2", DimSize="4 5"), "three axes"),
    "channels": (metaimage_header(ElementNumberOfChannels="x"), "positive counts"),
    "type": (metaimage_header(ElementType="MET_STRING"), "only"),
    "text": (metaimage_header(BinaryData="False"), "cannot hold"),
    "flag": (metaimage_header(CompressedData="maybe"), "must be True or False"),
    "no direction": (metaimage_header(TransformMatrix=None), "TransformMatrix: missing.*9 numbers"),
    "negative spacing": (metaimage_header(ElementSpacing="1 -1 1"), "must be positive"),
    "no spacing": (metaimage_header(ElementSpacing=None), "ElementSize: missing.*3 numbers"),
    "NaN": (metaimage_header(Offset="nan 0 0"), "3 numbers"),
    "too large": (metaimage_header(TransformMatrix="1 0 0 1e308 1 0 0 0 1"), "flattens"),
    "singular": (metaimage_header(TransformMatrix="0 0 0 0 1 0 0 0 1"), "flattens"),
    "skip": (metaimage_header(HeaderSize="-5"), "HeaderSize"),
    "skip into the header": (metaimage_header(HeaderSize="3"), "HeaderSize"),
    "skip packed": (metaimage_header(HeaderSize="5", CompressedData="True"), "HeaderSize"),
    "no zlib": (metaimage_header(CompressedData="True"), "damaged"),
    "control": (metaimage_header(ElementType="\x1b[2J"), "only"),
}
BAD_FILES = [
    *((f"a{ending}", name, words) for ending in (".nii", ".nii.gz") for name, (_, words) in BAD_NIFTI.items()),
    *(("a.nrrd", name, words) for name, (_, words) in BAD_NRRD.items()),
    *(("a.mha", name, words) for name, (_, words) in BAD_METAIMAGE.items()),
]


@pytest.mark.parametrize(("file", "name", "words"), BAD_FILES)
def test_a_bad_header_is_refused_with_its_reason(tmp_path: Path, file: str, name: str, words: str) -> None:
    if ".nii" in file:
        content = nifti(BAD_NIFTI[name][0])
        content = gzip.compress(content) if file.endswith(".gz") else content
    else:
        content = (BAD_NRRD if file == "a.nrrd" else BAD_METAIMAGE)[name][0] + voxels()
    path = write(tmp_path / file, content)
    with pytest.raises(InputDataError, match=words) as caught:
        read_label_image(path)
    assert str(path) in str(caught.value)
    assert str(caught.value).isprintable()


@pytest.mark.parametrize("ending", PACKED)
@pytest.mark.parametrize(
    ("stored", "spoilt", "words"),
    [
        (voxels(), lambda packed: packed[:-20], "damaged|cut short"),
        (voxels(), lambda packed: packed[:-4] + bytes(4), "damaged"),
        (voxels()[:-1], bytes, "damaged|cut short"),
        (voxels() + bytes(50_000_000), bytes, "has more than"),
    ],
    ids=["cut", "changed", "short", "a bomb"],
)
def test_a_packed_stream_that_holds_less_or_more_than_its_header_says_is_refused(
    tmp_path: Path, ending: str, stored: bytes, spoilt: Callable[[bytes], bytes], words: str
) -> None:
    head, packed = PACKED[ending](stored, (4, 5, 6))
    with pytest.raises(InputDataError, match=words):
        read_label_image(write(tmp_path / f"a{ending}", head + spoilt(packed)))


@pytest.mark.parametrize("ending", PACKED)
def test_a_small_file_cannot_make_the_reader_take_much_memory(tmp_path: Path, ending: str) -> None:
    path = write(tmp_path / f"a{ending}", b"".join(PACKED[ending](voxels(), (800, 800, 800))))
    tracemalloc.start()
    try:
        with pytest.raises(InputDataError, match="cannot hold"):
            read_label_image(path)
        assert tracemalloc.get_traced_memory()[1] < 2_000_000  # bytes, of the 512 000 000 that it promises
    finally:
        tracemalloc.stop()


@pytest.mark.parametrize("ending", PACKED)
def test_packed_voxels_take_no_more_memory_than_the_image(tmp_path: Path, ending: str) -> None:
    path = write(tmp_path / f"a{ending}", b"".join(PACKED[ending](bytes(2**26), (256, 256, 1024))))
    tracemalloc.start()
    try:
        format_of(path).stored(path, None)
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert 2**26 < peak < 1.5 * 2**26


@pytest.mark.parametrize(
    ("ending", "header", "key"),
    [(".nhdr", nrrd_header, "data_file"), (".mhd", metaimage_header, "ElementDataFile")],
)
def test_voxels_beside_a_header_are_read_from_its_own_folder_alone(
    tmp_path: Path, ending: str, header: Callable[..., bytes], key: str
) -> None:
    folder = tmp_path / "case"
    (folder / "inner").mkdir(parents=True)
    secret = write(tmp_path / "secret.raw", voxels())
    write(folder / "voxels.raw", voxels())
    (folder / "link.raw").symlink_to(secret)
    (folder / "loop.raw").symlink_to(folder / "loop.raw")
    (folder / "inner" / "up").symlink_to(tmp_path)
    (folder / "inner" / "a.raw").symlink_to(folder / "voxels.raw")
    outside = ("../secret.raw", str(secret), "link.raw", "inner/up/secret.raw", "inner/../../secret.raw")
    refused = dict.fromkeys(outside, "outside its own folder")
    refused |= dict.fromkeys(("missing.raw", "inner", "loop.raw", "x" * 300, "a\0b"), "no such file")
    refused |= dict.fromkeys(("LIST", "slice%03d.raw 1 6 1"), "several files")
    for name, words in refused.items():
        with pytest.raises(InputDataError, match=words):
            read_label_image(write(folder / f"a{ending}", header(**{key: name})))
    for name in ("voxels.raw", "inner/a.raw"):
        image = read_label_image(write(folder / f"a{ending}", header(**{key: name})))
        assert np.array_equal(image.labels, labels())
