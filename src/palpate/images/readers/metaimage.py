"""MetaImage files (.mha, .mhd), as ITK writes and reads them: world coordinates are LPS mm.

Format: https://itk.org/Wiki/MetaIO/Documentation; a row of TransformMatrix is the direction of one axis. Nothing but
size, type, place and packing is taken from the header; names and comments in it never leave this file.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path
from typing import BinaryIO

import numpy as np
from numpy.typing import NDArray

from palpate.errors import InputDataError
from palpate.images.label_image import LPS_TO_RAS
from palpate.images.named_labels import printable
from palpate.images.readers.registry import ImageFormat, StoredImage, register
from palpate.images.readers.text_header import counts, header_line, numbers, voxels_of
from palpate.images.readers.voxel_stream import MAX_OFFSET, VoxelBlock, bytes_to_skip, opened, read_block

SYNONYMS = {
    "rotation": "transformmatrix",
    "orientation": "transformmatrix",
    "position": "offset",
    "origin": "offset",
    "elementbyteordermsb": "binarydatabyteordermsb",
}
TYPES = {
    "MET_CHAR": "i1",
    "MET_UCHAR": "u1",
    "MET_SHORT": "i2",
    "MET_USHORT": "u2",
    "MET_INT": "i4",
    "MET_UINT": "u4",
    "MET_LONG": "i4",
    "MET_ULONG": "u4",
    "MET_LONG_LONG": "i8",
    "MET_ULONG_LONG": "u8",
    "MET_FLOAT": "f4",
    "MET_DOUBLE": "f8",
}
LAST = "elementdatafile"


def read_metaimage(path: Path) -> StoredImage:
    """Read one image of three axes from `path`; raises `InputDataError` with a sentence for whatever is wrong."""
    with opened(path) as file:
        header = _header(file, path)
        block, affine = _block(header, path), _affine(header, path)
        name = None if header[LAST].upper() == "LOCAL" else header[LAST]
        values, digests = voxels_of(file, path, name, lambda rest: read_block(rest, block, path))
    return StoredImage(values.reshape(block.shape[:3], order="F"), affine, digests=digests)


def _header(file: BinaryIO, path: Path) -> dict[str, str]:
    """Fields in lower case, up to the one that says where the voxels are."""
    fields: dict[str, str] = {}
    while LAST not in fields:
        line = header_line(file, path)
        name, equals, value = (line or "").partition("=")
        if line is None or not equals or not re.fullmatch(r"\w+", name.strip(), re.ASCII):
            raise InputDataError(
                f"'{path}' does not begin as a MetaImage file does; export the image as MetaImage or NIfTI"
            )
        name = name.strip().lower()
        name = SYNONYMS.get(name, name)
        if name in fields:
            raise InputDataError(f"the header of '{path}' has '{name[:60]}' twice; export the image again")
        fields[name] = value.strip()
    return fields


def _need(header: Mapping[str, str], field: str, path: Path, advice: str = "export the image again") -> str:
    if field not in header:
        raise InputDataError(f"the header of '{path}' has no '{field}'; {advice}")
    return header[field]


def _block(header: Mapping[str, str], path: Path) -> VoxelBlock:
    sizes = counts(_need(header, "dimsize", path), path, field="DimSize")
    channels = header.get("elementnumberofchannels", "1")
    if _need(header, "ndims", path) != str(len(sizes)):
        raise InputDataError(f"the header of '{path}' has NDims and DimSize that disagree; export the image again")
    if len(sizes) != 3 or channels != "1":
        raise InputDataError(
            f"'{path}' has the sizes {sizes[:16]} and {printable(channels[:20])} channels, but an image of three axes"
            " and one channel is needed; extract one volume (a time point, a channel)"
        )
    code = TYPES.get(_need(header, "elementtype", path))
    if code is None or not _flag(header, "binarydata", path, default=True):
        raise InputDataError(
            f"the voxels of '{path}' are of the type '{printable(header['elementtype'][:40])}' or written as text; only"
            " binary integers and floats of up to 64 bits are read: export the image again"
        )
    dtype = np.dtype(code).newbyteorder(">" if _flag(header, "binarydatabyteordermsb", path) else "<")
    packing = "zlib" if _flag(header, "compresseddata", path) else "raw"
    text = header.get("headersize", "0")
    skip = bytes_to_skip(text, packing)
    if skip is None or (packing != "raw" and text != "0"):
        raise InputDataError(
            f"the header of '{path}' has 'HeaderSize = {printable(text[:30])}', not a number of bytes from 0 to"
            f" {MAX_OFFSET}; export the image again"
        )
    return VoxelBlock(sizes, dtype, packing, skip)


def _flag(header: Mapping[str, str], field: str, path: Path, *, default: bool = False) -> bool:
    value = header.get(field, str(default)).lower()
    if value not in ("true", "false", "1", "0"):
        raise InputDataError(
            f"the header of '{path}' has '{field} = {printable(value[:30])}', not True or False; correct it"
        )
    return value in ("true", "1")


def _affine(header: Mapping[str, str], path: Path) -> NDArray[np.float64]:
    """Index -> RAS mm; ITK takes the world of every MetaImage for LPS, whatever AnatomicalOrientation says."""
    unknown = "so left and right are unknown; export the image with its orientation"
    rows = numbers(_need(header, "transformmatrix", path, unknown), 9, path, field="TransformMatrix").reshape(3, 3)
    sizes = header.get("elementspacing", header.get("elementsize"))
    if sizes is None:
        raise InputDataError(
            f"the header of '{path}' has no 'ElementSpacing', so its scale is unknown; export it again"
        )
    spacing = numbers(sizes, 3, path, field="ElementSpacing")
    if not (spacing > 0.0).all():
        raise InputDataError(
            f"the header of '{path}' has the ElementSpacing {spacing.tolist()}, which must be positive: programs take a"
            " sign there for a mirror or not; turn the axis in TransformMatrix, or export the image again"
        )
    affine = np.eye(4)
    affine[:3, :3] = LPS_TO_RAS[:, None] * rows.T * spacing
    affine[:3, 3] = LPS_TO_RAS * numbers(header.get("offset", "0 0 0"), 3, path, field="Offset")
    return affine + 0.0  # no minus zero


register(ImageFormat("MetaImage", (".mha", ".mhd"), read_metaimage))
