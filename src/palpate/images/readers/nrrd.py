"""NRRD files (.nrrd, .nhdr) and the segmentations of 3D Slicer (.seg.nrrd), with every size checked before it is used.

Format: https://teem.sourceforge.net/nrrd/format.html, version 5. Only what places voxels in the world is kept of the
header, and of a segmentation the names, colours, values and layers of its segments; free keys never leave this file.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from palpate.errors import InputDataError
from palpate.images.input_file import InputFile
from palpate.images.named_labels import printable
from palpate.images.readers.registry import ImageFormat, StoredImage, register
from palpate.images.readers.segments import flattened, segments_of
from palpate.images.readers.text_header import TextHeader, header_line, voxels_of
from palpate.images.readers.voxel_stream import MAX_OFFSET, VoxelBlock, bytes_to_skip, opened, read_block

SYNONYMS = {"datafile": "data file", "lineskip": "line skip", "byteskip": "byte skip"}
RAS_SIGNS = {  # of the three world axes
    "right-anterior-superior": (1, 1, 1),
    "ras": (1, 1, 1),
    "left-anterior-superior": (-1, 1, 1),
    "las": (-1, 1, 1),
    "left-posterior-superior": (-1, -1, 1),
    "lps": (-1, -1, 1),
}
TYPES = {
    name: code
    for code, names in {
        "i1": "signed char,int8,int8_t",
        "u1": "uchar,unsigned char,uint8,uint8_t",
        "i2": "short,short int,signed short,signed short int,int16,int16_t",
        "u2": "ushort,unsigned short,unsigned short int,uint16,uint16_t",
        "i4": "int,signed int,int32,int32_t",
        "u4": "uint,unsigned int,uint32,uint32_t",
        "i8": "longlong,long long,long long int,signed long long,signed long long int,int64,int64_t",
        "u8": "ulonglong,unsigned long long,unsigned long long int,uint64,uint64_t",
        "f4": "float",
        "f8": "double",
    }.items()
    for name in names.split(",")
}
PACKINGS = {"raw": "raw", "gzip": "gzip", "gz": "gzip"}
MILLIMETRES = {"mm": 1.0, "millimeter": 1.0, "m": 1000.0, "cm": 10.0, "um": 0.001, "": 1.0}
VECTOR = re.compile(r"none|\(([^()]*)\)", re.IGNORECASE)


def read_nrrd(path: Path) -> StoredImage:
    """Read one image of three axes, or a segmentation with its layers, from `path`.

    Layers that do not overlap become one label image. Raises `InputDataError` with a sentence for whatever is wrong.
    """
    with opened(path) as file:
        header, keys = _header(file, path)
        block, (affine, list_axes) = _block(header), _place(header)
        text = header.fields.get("line skip", "0")
        if not (text.isascii() and text.isdigit() and len(text) <= 4):
            raise header.refused("line skip", "it must lie between 0 and 9999; export the image again")

        def voxels(rest: InputFile) -> NDArray[Any]:
            """Those behind the lines that are to be skipped."""
            for _ in range(int(text)):
                header_line(rest, path)
            return read_block(rest, block, path)

        values, digests = voxels_of(file, path, header.fields.get("data file"), voxels)
    segments = segments_of(keys, path)
    lists = [k for k in list_axes if values.shape[k] > 1]
    if len(lists) > 1 or (lists and not segments):
        raise InputDataError(
            f"'{path}' has the sizes {list(values.shape)}, but an image of three axes is needed; extract one volume (a"
            " time point, a channel)"
        )
    keep = lists[:1]
    squeezed = np.squeeze(values, axis=tuple(k for k in list_axes if k not in keep))
    if not segments:
        return StoredImage(squeezed, affine, digests=digests)
    layers = np.moveaxis(squeezed, keep[0], 0) if keep else squeezed[None]
    labels, names = flattened(layers, segments, path)
    return StoredImage(labels, affine, names, digests)


def _header(file: BinaryIO, path: Path) -> tuple[TextHeader, dict[str, str]]:
    """The header's fields, and its key-values."""
    first = header_line(file, path) or ""
    if not re.fullmatch(r"NRRD000[1-5]\s*", first):
        raise InputDataError(f"'{path}' does not begin as an NRRD file does; export the image as NRRD or NIfTI")
    fields: dict[str, str] = {}
    keys: dict[str, str] = {}
    while line := header_line(file, path):
        if line.startswith("#"):
            continue
        field, colon, value = line.partition(":")
        if not colon:
            raise InputDataError(
                f"the header of '{path}' has the line '{printable(line[:60])}'; export the image again"
            )
        known, name = (keys, field) if value.startswith("=") else (fields, field.strip().lower())
        name = SYNONYMS.get(name, name)
        if name in known:
            raise InputDataError(f"the header of '{path}' has '{printable(name[:60])}' twice; export the image again")
        known[name] = value[1:] if known is keys else value.strip()
    return TextHeader(fields, path), keys


def _block(header: TextHeader) -> VoxelBlock:
    sizes = header.counts("sizes")
    if header.need("dimension") != str(len(sizes)) or len(sizes) > 16:
        raise header.refused("dimension", f"but {len(sizes)} sizes; export the image again")
    code = TYPES.get(header.need("type").lower())
    if code is None:
        raise header.refused("type", "only integers and floats of up to 64 bits are read: export one channel")
    packing = PACKINGS.get(header.need("encoding").lower())
    if packing is None:
        raise header.refused("encoding", "only raw and gzip are read; save the image with one of them")
    endian = header.fields.get("endian", "little" if code[1] == "1" else "").lower()
    if endian not in ("little", "big"):
        raise header.refused("endian", "it must be little or big; export the image again")
    skip = bytes_to_skip(header.fields.get("byte skip", "0"), packing)
    if skip is None:
        raise header.refused("byte skip", f"it must lie between 0 and {MAX_OFFSET}; export the image again")
    return VoxelBlock(sizes, np.dtype(code).newbyteorder("<" if endian == "little" else ">"), packing, skip)


def _place(header: TextHeader) -> tuple[NDArray[np.float64], tuple[int, ...]]:
    """The affine (4, 4) index -> RAS mm of the axes in space, and which axis, if any, lists layers or channels.

    By `space`, `space directions` and `space origin`; a missing origin is zero, as ITK has it.
    """
    path = header.path
    signs = RAS_SIGNS.get(header.fields.get("space", "").lower())
    if signs is None or "space directions" not in header.fields:
        raise InputDataError(
            f"the header of '{path}' does not say where right, front and head are (its space is"
            f" '{printable(header.fields.get('space', 'missing')[:40])}'); export it with its orientation (LPS, RAS)"
        )
    vectors = list(VECTOR.finditer(header.fields["space directions"]))
    in_space = [k for k, vector in enumerate(vectors) if vector[1] is not None]
    if str(len(vectors)) != header.need("dimension") or len(in_space) != 3:
        raise header.refused("space directions", "an image of three axes is needed; extract one volume")
    affine = np.eye(4)
    for column, k in enumerate(in_space):
        affine[:3, column] = header.numbers("space directions", 3, vectors[k][1].replace(",", " "))
    origin = VECTOR.fullmatch(header.fields.get("space origin", "(0,0,0)"))
    affine[:3, 3] = header.numbers("space origin", 3, ((origin and origin[1]) or "").replace(",", " "))
    units = set(re.findall(r'"([^"]*)"', header.fields.get("space units", '"mm"')))
    if len(units) != 1 or not units <= set(MILLIMETRES):
        raise header.refused("space units", 'it must be "mm" "mm" "mm"; correct it')
    affine[:3] *= np.array(signs)[:, None] * MILLIMETRES[units.pop()]
    affine += 0.0  # no minus zero
    return affine, tuple(k for k in range(len(vectors)) if k not in in_space)


register(ImageFormat("NRRD", (".nrrd", ".nhdr"), read_nrrd))
