"""MetaImage files (.mha, .mhd), as ITK writes and reads them: world coordinates are LPS mm.

Format: https://itk.org/Wiki/MetaIO/Documentation; a row of TransformMatrix is the direction of one axis. Nothing but
size, type, place and packing is taken from the header; names and comments in it never leave this file.
"""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from palpate.errors import InputDataError
from palpate.images.label_image import LPS_TO_RAS
from palpate.images.named_labels import printable
from palpate.images.readers.registry import ImageFormat, StoredImage, register
from palpate.images.readers.text_header import TextHeader, header_line, voxels_of
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
        fields: dict[str, str] = {}  # in lower case, up to the one that says where the voxels are
        while LAST not in fields:
            line = header_line(file, path)
            name, equals, value = (line or "").partition("=")
            if line is None or not equals or not re.fullmatch(r"\w+", name.strip(), re.ASCII):
                raise InputDataError(
                    f"'{path}' does not begin as a MetaImage file does; export the image as MetaImage or NIfTI"
                )
            field = SYNONYMS.get(name.strip().lower(), name.strip().lower())
            if field in fields:
                raise InputDataError(f"the header of '{path}' has '{field[:60]}' twice; export the image again")
            fields[field] = value.strip()
        header = TextHeader(fields, path)
        block = _block(header)
        header.need("transformmatrix", "so left and right are unknown; export the image with its orientation")
        rows = header.numbers("transformmatrix", 9).reshape(3, 3)
        sizes = "elementspacing" if "elementspacing" in fields else "elementsize"
        header.need(sizes, "so its scale is unknown; export it again")
        spacing = header.numbers(sizes, 3)
        if not (spacing > 0.0).all():
            raise header.refused(
                sizes,
                "it must be positive: programs take a sign there for a mirror or not; turn the axis in TransformMatrix,"
                " or export the image again",
            )
        affine = np.eye(4)  # ITK takes the world of every MetaImage for LPS, whatever AnatomicalOrientation says
        affine[:3, :3] = LPS_TO_RAS[:, None] * rows.T * spacing
        affine[:3, 3] = LPS_TO_RAS * header.numbers("offset", 3, fields.get("offset", "0 0 0"))
        beside = None if fields[LAST].upper() == "LOCAL" else fields[LAST]
        values, digests = voxels_of(file, path, beside, lambda rest: read_block(rest, block, path))
    return StoredImage(values.reshape(block.shape[:3], order="F"), affine + 0.0, digests=digests)  # no minus zero


def _block(header: TextHeader) -> VoxelBlock:
    sizes, channels = header.counts("dimsize"), header.fields.get("elementnumberofchannels", "1")
    if header.need("ndims") != str(len(sizes)):
        raise header.refused("ndims", "DimSize disagrees with it: export the image again")
    if len(sizes) != 3 or channels != "1":
        raise InputDataError(
            f"'{header.path}' has the sizes {sizes[:16]} and {printable(channels[:20])} channels, but an image of three"
            " axes and one channel is needed; extract one volume (a time point, a channel)"
        )
    code = TYPES.get(header.need("elementtype"))
    if code is None or not _flag(header, "binarydata", default=True):
        advice = "only voxels of binary integers and floats of up to 64 bits are read: export the image again"
        raise header.refused("elementtype", advice)
    dtype = np.dtype(code).newbyteorder(">" if _flag(header, "binarydatabyteordermsb") else "<")
    packing = "zlib" if _flag(header, "compresseddata") else "raw"
    text = header.fields.get("headersize", "0")
    skip = bytes_to_skip(text, packing)
    if skip is None or (packing != "raw" and text != "0"):
        raise header.refused("headersize", f"HeaderSize lies between 0 and {MAX_OFFSET}: export it again")
    return VoxelBlock(sizes, dtype, packing, skip)


def _flag(header: TextHeader, field: str, *, default: bool = False) -> bool:
    value = header.fields.get(field, str(default)).lower()
    if value not in ("true", "false", "1", "0"):
        raise header.refused(field, "it is not True or False: correct it")
    return value in ("true", "1")


register(ImageFormat("MetaImage", (".mha", ".mhd"), read_metaimage))
