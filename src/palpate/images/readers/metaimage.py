"""MetaImage files (.mha, .mhd), as ITK writes them: world coordinates are LPS mm.

Format: https://itk.org/Wiki/MetaIO/Documentation; a row of TransformMatrix is the direction of one axis. What neither
places nor decodes voxels (comments, copies of DICOM fields) never leaves this file.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from palpate.errors import InputDataError
from palpate.images.label_image import LPS_TO_RAS
from palpate.images.readers.registry import ImageFormat, StoredImage, register
from palpate.images.readers.text_header import StoredArray, header_lines, numbers_in, refused, voxels_of
from palpate.images.readers.voxel_stream import VoxelBlock, opened

SYNONYMS = {"Rotation": "TransformMatrix", "Orientation": "TransformMatrix", "Position": "Offset", "Origin": "Offset"}
BIG_ENDIAN = ("BinaryDataByteOrderMSB", "ElementByteOrderMSB")
TYPES = {"CHAR": "i1", "SHORT": "i2", "INT": "i4", "LONG": "i4", "LONG_LONG": "i8", "FLOAT": "f4", "DOUBLE": "f8"}
TYPES |= {f"U{name}": f"u{code[1]}" for name, code in TYPES.items() if code[0] == "i"}
LAST = "ElementDataFile"
USED = {*BIG_ENDIAN, *SYNONYMS.values(), LAST, "NDims", "DimSize", "ElementSpacing", "ElementSize", "DistanceUnits"}
USED |= {"ElementType", "ElementNumberOfChannels", "BinaryData", "CompressedData", "HeaderSize"}


def read_metaimage(path: Path) -> StoredImage:
    """Read one image of three axes from `path`; raises `InputDataError` with a sentence for whatever is wrong."""
    array = metaimage_content(path)
    return StoredImage(array.layers(path, 1)[0], array.affine, digests=array.digests)


def metaimage_content(path: Path) -> StoredArray:
    """Voxels of three axes in space and any others, of which the channels are the first.

    Raises `InputDataError` with a sentence for whatever is wrong.
    """
    with opened(path) as file:
        fields = _fields(header_lines(file, path, rf"\s*{LAST}\s*[=:]"), path)
        channels, *_ = _counts(fields, "ElementNumberOfChannels", path, "1")
        sizes = _counts(fields, "DimSize", path)
        affine = _affine(fields, len(sizes), path)
        kind = fields.get("ElementType", "").removeprefix("MET_")
        if kind not in TYPES:
            raise refused(path, "ElementType", kind, "only integers and floats of up to 64 bits are read")
        order = ">" if any(_flag(fields, name, path) for name in BIG_ENDIAN) else "<"
        packed, binary = _flag(fields, "CompressedData", path), _flag(fields, "BinaryData", path, "True")
        beside = None if fields[LAST].upper() == "LOCAL" else fields[LAST]
        skip = int(_numbers(fields, "HeaderSize", path, 1, [0.0])[0])
        skip -= file.tell() if beside is None and skip > 0 else 0  # it counts from the start of the file
        if skip < -1 or (skip and packed):
            raise refused(path, "HeaderSize", fields["HeaderSize"], "voxels cannot begin there; export the image again")
        packing = "zlib" if packed else "raw" if binary else "ascii"
        block = VoxelBlock((channels, *sizes), np.dtype(order + TYPES[kind]), packing, skip)
        values, digests = voxels_of(file, path, beside, block)
    return StoredArray(values, affine, (0, *range(4, values.ndim)), digests)


def _fields(lines: list[str], path: Path) -> dict[str, str]:
    """What places and decodes voxels, by its name; a field may be there twice, or under two names, if both agree."""
    fields: dict[str, str] = {}
    for line in lines:
        name, *value = (part.strip() for part in re.split("[=:]", line, maxsplit=1))
        name = SYNONYMS.get(name, name)
        if name not in USED or not value:
            continue
        first, second = fields.setdefault(name, value[0]).split(), value[0].split()
        if first != second and not (numbers_in(first) and numbers_in(first) == numbers_in(second)):
            raise refused(path, name, fields[name], "it is there twice, with different values; delete the wrong one")
    if LAST not in fields:
        raise InputDataError(f"'{path}' does not begin as a MetaImage file does; export it as MetaImage or NIfTI")
    return fields


def _affine(fields: Mapping[str, str], n: int, path: Path) -> NDArray[np.float64]:
    """Index -> RAS mm; ITK takes the world of every MetaImage for LPS, whatever AnatomicalOrientation says."""
    if fields.get("NDims") != str(n) or n < 3:
        raise refused(
            path, "NDims", fields.get("NDims"), f"three axes are needed, but DimSize has {n} sizes; export it again"
        )
    rows = np.reshape(_numbers(fields, "TransformMatrix", path, n * n), (n, n))
    name = "ElementSpacing" if "ElementSpacing" in fields else "ElementSize"
    spacing = np.array(_numbers(fields, name, path, n))
    if not (spacing > 0.0).all():
        raise refused(path, name, fields[name], "it must be positive; reverse the axis in TransformMatrix instead")
    if rows[:3, 3:].any() or rows[3:, :3].any():
        raise refused(path, "TransformMatrix", fields["TransformMatrix"], "it mixes space and time; extract one volume")
    if fields.get("DistanceUnits", "mm") not in ("mm", "?"):
        raise refused(
            path, "DistanceUnits", fields["DistanceUnits"], "most programs ignore that unit; write lengths in mm"
        )
    affine, origin = np.eye(4), _numbers(fields, "Offset", path, n, [0.0] * n)
    with np.errstate(over="ignore"):  # what is not finite is refused later, with its numbers
        affine[:3, :3] = LPS_TO_RAS[:, None] * rows[:3, :3].T * spacing[:3]
    affine[:3, 3] = LPS_TO_RAS * origin[:3]
    return affine + 0.0  # no minus zero


def _counts(fields: Mapping[str, str], name: str, path: Path, default: str = "missing") -> list[int]:
    words = fields.get(name, default).split()
    sizes = [int(word) for word in words if word.isascii() and word.isdigit() and len(word) <= 20]
    if len(sizes) != len(words) or not sizes or min(sizes) < 1:
        raise refused(path, name, " ".join(words), "positive counts are needed; export the image again")
    return sizes


def _numbers(
    fields: Mapping[str, str], name: str, path: Path, n: int, default: list[float] | None = None
) -> list[float]:
    """The `n` numbers of a field."""
    found = numbers_in(fields[name].split()) if name in fields else default
    if found is None or len(found) != n:
        advice = f"{n} numbers are needed to place the image; export it again with them"
        raise refused(path, name, fields.get(name, "missing"), advice)
    return found


def _flag(fields: Mapping[str, str], name: str, path: Path, default: str = "False") -> bool:
    value = fields.get(name, default).lower()
    if value not in ("true", "false", "1", "0"):
        raise refused(path, name, value, "it must be True or False; correct it")
    return value in ("true", "1")


register(ImageFormat("MetaImage", (".mha", ".mhd"), read_metaimage))
