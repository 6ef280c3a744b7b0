"""MetaImage: every layout gives the same image; a sentence for each bad header."""

from __future__ import annotations

import gzip
import tracemalloc
import zlib
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import SimpleITK
from numpy.typing import NDArray

from palpate.errors import InputDataError
from palpate.images import readers

read_label_image = partial(readers.read_label_image, limits=None)
read_intensities = partial(readers.read_intensities, limits=None)

HEADER = {
    "ObjectType": "Image",
    "NDims": "3",
    "BinaryData": "True",
    "BinaryDataByteOrderMSB": "False",
    "CompressedData": "False",
    "TransformMatrix": "-1 0 0 0 -1 0 0 0 1",
    "Offset": "20 -7 -3.5",
    "ElementSpacing": "0.5 1 2.5",
    "DimSize": "4 5 6",
    "ElementType": "MET_UCHAR",
    "ElementDataFile": "LOCAL",
}
AFFINE = np.array([[0.5, 0, 0, -20], [0, 1.0, 0, 7], [0, 0, 2.5, -3.5], [0, 0, 0, 1]])


def labels() -> NDArray[np.uint8]:
    return np.random.default_rng(3).integers(0, 5, (4, 5, 6), dtype=np.uint8)


def header(**changes: str | None) -> bytes:
    fields = {**HEADER, **changes}
    last = fields.pop("ElementDataFile")
    lines = [f"{key} = {value}" for key, value in fields.items() if value is not None]
    return "\n".join([*lines, f"ElementDataFile = {last}", ""]).encode()


def write(path: Path, content: bytes) -> Path:
    path.write_bytes(content)
    return path


@pytest.mark.parametrize(
    ("changes", "pack"),
    [
        ({}, bytes),
        ({"CompressedData": "True"}, zlib.compress),
        ({"CompressedData": "True", "CompressedDataSize": "77"}, gzip.compress),
        ({"TransformMatrix": None, "Rotation": "-1 0 0 0 -1 0 0 0 1"}, bytes),
        ({"Offset": None, "Position": "20 -7 -3.5"}, bytes),
        ({"ElementSpacing": None, "ElementSize": "0.5 1 2.5"}, bytes),
        ({"HeaderSize": "-1"}, lambda content: b"abc" + content),
        ({"HeaderSize": "1000"}, lambda content: b"x" * (1000 - len(header(HeaderSize="1000"))) + content),
        ({"BinaryData": "False"}, lambda content: " ".join(map(str, content)).encode()),
        ({"0008|0060": "CT", "0018|0050": "2.0", "ITK original": "x", "Comment": "a = b: c"}, bytes),
        (
            {"ObjectSubType": "None", "AnatomicalOrientation": "LPS", "CenterOfRotation": "0 0 0", "Modality": "?"},
            bytes,
        ),
        ({"Offset": "20 -7 -3.5\nPosition = 20.0 -7.0 -3.50\nOrigin = 20 -7 -3.5", "DistanceUnits": "mm"}, bytes),
        ({"ElementType": "MET_UCHAR\nElementType = MET_UCHAR\nComment = one\nComment = two"}, bytes),
        (
            {
                "NDims": "4",
                "DimSize": "4 5 6 1",
                "TransformMatrix": "-1 0 0 0 0 -1 0 0 0 0 1 0 0 0 0 1",
                "Offset": "20 -7 -3.5 0",
                "ElementSpacing": "0.5 1 2.5 1",
            },
            bytes,
        ),
        ({"ElementNumberOfChannels": "1", "ElementToIntensityFunctionSlope": "1", "ElementMax": "4"}, bytes),
    ],
)
def test_every_layout_gives_the_same_image(tmp_path: Path, changes, pack) -> None:
    image = read_label_image(write(tmp_path / "a.mha", header(**changes) + pack(labels().tobytes(order="F"))))
    assert np.array_equal(image.labels, labels())
    assert np.array_equal(image.grid.affine, AFFINE)


@pytest.mark.parametrize("kind", ["sitkInt8", "sitkUInt16", "sitkInt32", "sitkUInt64", "sitkFloat32", "sitkFloat64"])
def test_every_number_type_gives_the_same_labels(tmp_path: Path, kind: str) -> None:
    image = SimpleITK.Cast(SimpleITK.GetImageFromArray(labels().T), getattr(SimpleITK, kind))
    image.SetDirection((-1, 0, 0, 0, -1, 0, 0, 0, 1))
    SimpleITK.WriteImage(image, str(tmp_path / "a.mha"), True)
    assert np.array_equal(read_label_image(tmp_path / "a.mha").labels, labels())
    assert read_intensities(tmp_path / "a.mha")[0].dtype == np.float32


def test_other_signs_and_line_ends_are_read(tmp_path: Path) -> None:
    for head in (header().replace(b" = ", b"="), header().replace(b" = ", b": "), header().replace(b"\n", b"\r\n")):
        image = read_label_image(write(tmp_path / "a.mha", head + labels().tobytes(order="F")))
        assert np.array_equal(image.labels, labels())


def test_all_axes_are_there_for_those_who_can_use_them(tmp_path: Path) -> None:
    vectors = np.random.default_rng(4).normal(size=(3, 4, 5, 6))
    image = SimpleITK.GetImageFromArray(vectors.T, isVector=True)
    image.SetOrigin((1.0, 2.0, 3.0))
    SimpleITK.WriteImage(image, str(tmp_path / "a.mha"), True)
    array = readers.metaimage.metaimage_content(tmp_path / "a.mha")
    assert np.array_equal(array.layers(tmp_path / "a.mha"), vectors)
    assert array.affine[:3, 3].tolist() == [-1.0, -2.0, 3.0]


def test_big_endian_voxels_are_read(tmp_path: Path) -> None:
    content = header(ElementType="MET_SHORT", BinaryDataByteOrderMSB="True") + labels().astype(">i2").tobytes(order="F")
    assert np.array_equal(read_label_image(write(tmp_path / "a.mha", content)).labels, labels())


def test_data_outside_the_folder_are_not_followed(tmp_path: Path) -> None:
    folder = tmp_path / "case"
    folder.mkdir()
    secret = write(tmp_path / "secret.raw", labels().tobytes(order="F"))
    (folder / "link.raw").symlink_to(secret)
    for name in ("../secret.raw", str(secret), "link.raw"):
        with pytest.raises(InputDataError, match="outside its own folder"):
            read_label_image(write(folder / "a.mhd", header(ElementDataFile=name)))
    for name in ("LIST", "slice%03d.raw 1 6 1"):
        with pytest.raises(InputDataError, match="several files"):
            read_label_image(write(folder / "a.mhd", header(ElementDataFile=name)))
    write(folder / "voxels.raw", labels().tobytes(order="F"))
    path = write(folder / "a.mhd", header(ElementDataFile="voxels.raw"))
    assert np.array_equal(read_label_image(path).labels, labels())


BAD_HEADERS = {
    "no MetaImage": (b"\x89PNG\r\n\x1a\n", "does not begin"),
    "no data": (b"ObjectType = Image\n", "does not begin"),
    "twice": (b"NDims = 2\n" + header(), "twice"),
    "two places": (header(Position="1 2 3"), "twice"),
    "units": (header(DistanceUnits="m"), "lengths in mm"),
    "two channels": (header(ElementNumberOfChannels="2", DimSize="4 5 3"), "one channel"),
    "two times": (
        header(
            NDims="4",
            DimSize="2 5 6 2",
            TransformMatrix="1 0 0 0 0 1 0 0 0 0 1 0 0 0 0 1",
            Offset="0 0 0 0",
            ElementSpacing="1 1 1 1",
        ),
        "one channel",
    ),
    "no sizes": (header(DimSize=None), "DimSize: missing"),
    "size no number": (header(DimSize="4 ² 6"), "positive counts"),
    "zero size": (header(DimSize="4 0 6"), "positive counts"),
    "huge": (header(DimSize="99999 99999 99999"), "more than the"),
    "sizes not data": (header(DimSize="4 5 60"), "cannot hold"),
    "disagree": (header(NDims="2"), "DimSize has 3"),
    "two axes": (header(NDims="2", DimSize="4 5"), "three axes"),
    "channels": (header(ElementNumberOfChannels="x"), "positive counts"),
    "type": (header(ElementType="MET_STRING"), "only"),
    "text": (header(BinaryData="False"), "cannot hold"),
    "flag": (header(CompressedData="maybe"), "must be True or False"),
    "no direction": (header(TransformMatrix=None), "TransformMatrix: missing.*9 numbers"),
    "negative spacing": (header(ElementSpacing="1 -1 1"), "must be positive"),
    "no spacing": (header(ElementSpacing=None), "ElementSize: missing.*3 numbers"),
    "NaN": (header(Offset="nan 0 0"), "3 numbers"),
    "too large": (header(TransformMatrix="1 0 0 1e308 1 0 0 0 1"), "flattens"),
    "singular": (header(TransformMatrix="0 0 0 0 1 0 0 0 1"), "flattens"),
    "skip": (header(HeaderSize="-5"), "HeaderSize"),
    "skip into the header": (header(HeaderSize="3"), "HeaderSize"),
    "skip packed": (header(HeaderSize="5", CompressedData="True"), "HeaderSize"),
    "no zlib": (header(CompressedData="True"), "damaged"),
    "control": (header(ElementType="\x1b[2J"), "only"),
}


@pytest.mark.parametrize("name", BAD_HEADERS)
def test_a_bad_header_is_refused_with_its_reason(tmp_path: Path, name: str) -> None:
    content, words = BAD_HEADERS[name]
    path = write(tmp_path / "a.mha", content + labels().tobytes(order="F"))
    with pytest.raises(InputDataError, match=words) as caught:
        read_label_image(path)
    assert str(path) in str(caught.value)
    assert str(caught.value).isprintable()


def test_a_cut_or_endless_stream_is_refused(tmp_path: Path) -> None:
    head, voxels = header(CompressedData="True"), labels().tobytes(order="F")
    packed = zlib.compress(voxels)
    cases = (
        (packed[:-20], "damaged|cut short"),
        (packed[:-4] + b"\0" * 4, "damaged"),
        (zlib.compress(voxels[:-1]), "cut short"),
        (zlib.compress(voxels + bytes(50_000_000)), "has more than"),
    )
    for body, words in cases:
        with pytest.raises(InputDataError, match=words):
            read_label_image(write(tmp_path / "a.mha", head + body))
    with pytest.raises(InputDataError, match="cannot hold"):
        read_label_image(write(tmp_path / "a.mha", header(CompressedData="True", DimSize="800 800 800") + packed))


@pytest.mark.parametrize("pack", [zlib.compress, gzip.compress])
def test_packed_voxels_take_no_more_memory_than_the_image(tmp_path: Path, pack) -> None:
    image = write(tmp_path / "a.mha", header(CompressedData="True", DimSize="256 256 1024") + pack(bytes(2**26)))
    tracemalloc.start()
    try:
        readers.metaimage.read_metaimage(image)
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert 2**26 < peak < 1.5 * 2**26
