"""MetaImage: every layout gives the same image; a sentence for each bad header."""

from __future__ import annotations

import gzip
import zlib
from pathlib import Path

import numpy as np
import pytest
import SimpleITK

from image_files import AFFINE, labels, metaimage_header, read_label_image, voxels, write
from palpate.images import readers


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
        ({"HeaderSize": "1000"}, lambda content: b"x" * (1000 - len(metaimage_header(HeaderSize="1000"))) + content),
        (
            {"ElementType": "MET_SHORT", "BinaryDataByteOrderMSB": "True"},
            lambda content: np.frombuffer(content, np.uint8).astype(">i2").tobytes(),
        ),
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
    image = read_label_image(write(tmp_path / "a.mha", metaimage_header(**changes) + pack(voxels())))
    assert np.array_equal(image.labels, labels())
    assert np.array_equal(image.grid.affine, AFFINE)


def test_other_signs_and_line_ends_are_read(tmp_path: Path) -> None:
    for head in (
        metaimage_header().replace(b" = ", b"="),
        metaimage_header().replace(b" = ", b": "),
        metaimage_header().replace(b"\n", b"\r\n"),
    ):
        image = read_label_image(write(tmp_path / "a.mha", head + voxels()))
        assert np.array_equal(image.labels, labels())


def test_all_axes_are_there_for_those_who_can_use_them(tmp_path: Path) -> None:
    vectors = np.random.default_rng(4).normal(size=(3, 4, 5, 6))
    image = SimpleITK.GetImageFromArray(vectors.T, isVector=True)
    image.SetOrigin((1.0, 2.0, 3.0))
    SimpleITK.WriteImage(image, str(tmp_path / "a.mha"), True)
    array = readers.metaimage.metaimage_content(tmp_path / "a.mha")
    assert np.array_equal(array.layers(tmp_path / "a.mha"), vectors)
    assert array.affine[:3, 3].tolist() == [-1.0, -2.0, 3.0]
