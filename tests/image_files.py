"""One small label image as the bytes of each format, with a header that tests change."""

from __future__ import annotations

import gzip
import zlib
from collections.abc import Callable
from functools import partial
from pathlib import Path

import nibabel
import numpy as np
from numpy.typing import NDArray

from palpate.images import readers

# In this process: what the process of its own adds is tested in test_isolation.py.
read_label_image = partial(readers.read_label_image, limits=None)
read_intensities = partial(readers.read_intensities, limits=None)

AFFINE = np.array([[0.5, 0, 0, -20], [0, 1.0, 0, 7], [0, 0, 2.5, -3.5], [0, 0, 0, 1]])
NRRD = {
    "type": "uchar",
    "dimension": "3",
    "space": "right-anterior-superior",
    "sizes": "4 5 6",
    "space directions": "(0.5,0,0) (0,1,0) (0,0,2.5)",
    "kinds": "domain domain domain",
    "encoding": "raw",
    "space origin": "(-20,7,-3.5)",
}
METAIMAGE = {
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


def labels() -> NDArray[np.uint8]:
    return np.random.default_rng(3).integers(0, 5, (4, 5, 6), dtype=np.uint8)


def voxels() -> bytes:
    """As all these formats store them."""
    return labels().tobytes(order="F")


def nrrd_header(**changes: str | None) -> bytes:
    fields = {**NRRD, **{key.replace("_", " "): value for key, value in changes.items()}}
    lines = [f"{key}: {value}" for key, value in fields.items() if value is not None]
    return "\n".join(["NRRD0004", *lines, "", ""]).encode()


def metaimage_header(**changes: str | None) -> bytes:
    fields = {**METAIMAGE, **changes}
    last = fields.pop("ElementDataFile")
    lines = [f"{key} = {value}" for key, value in fields.items() if value is not None]
    return "\n".join([*lines, f"ElementDataFile = {last}", ""]).encode()


def nifti(change: Callable[[bytearray], None] | None = None) -> bytes:
    """Header and voxels, with `change` applied to the bytes."""
    content = bytearray(nibabel.Nifti1Image(labels(), AFFINE).to_bytes())
    if change is not None:
        change(content)
    return bytes(content)


def packed_nifti(stored: bytes, sizes: tuple[int, ...]) -> tuple[bytes, bytes]:
    header = nibabel.Nifti1Image(labels(), AFFINE).header.copy()
    header.set_sform(AFFINE, code=1)
    header.set_data_shape(sizes)
    return b"", gzip.compress(bytes(header.binaryblock) + bytes(4) + stored)


def packed_nrrd(stored: bytes, sizes: tuple[int, ...]) -> tuple[bytes, bytes]:
    return nrrd_header(encoding="gzip", sizes=" ".join(map(str, sizes))), gzip.compress(stored)


def packed_metaimage(stored: bytes, sizes: tuple[int, ...]) -> tuple[bytes, bytes]:
    return metaimage_header(CompressedData="True", DimSize=" ".join(map(str, sizes))), zlib.compress(stored)


PACKED = {".nii.gz": packed_nifti, ".nrrd": packed_nrrd, ".mha": packed_metaimage}  # plain head, and packed rest


def write(path: Path, content: bytes) -> Path:
    path.write_bytes(content)
    return path
