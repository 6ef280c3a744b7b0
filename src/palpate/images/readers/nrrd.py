"""NRRD files (.nrrd, .nhdr) and the segmentations of 3D Slicer (.seg.nrrd), with every size checked before it is used.

Format: https://teem.sourceforge.net/nrrd/format.html, version 5. pynrrd parses the header. Only what places voxels is
kept of it, and of a segmentation the names, colours, values, layers and place of its segments.
"""

from __future__ import annotations

import io
import re
from collections.abc import Mapping
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from palpate.errors import InputDataError
from palpate.images.label_image import VoxelGrid
from palpate.images.named_labels import printable
from palpate.images.readers.reference_grid import uncropped
from palpate.images.readers.registry import ImageFormat, StoredImage, register
from palpate.images.readers.segments import flattened, segments_of
from palpate.images.readers.text_header import StoredArray, header_lines, refused, voxels_of
from palpate.images.readers.voxel_stream import VoxelBlock, opened

RAS_SIGNS = {"right-anterior-superior": (1, 1, 1), "left-anterior-superior": (-1, 1, 1)}
RAS_SIGNS |= {"left-posterior-superior": (-1, -1, 1), "ras": (1, 1, 1), "las": (-1, 1, 1), "lps": (-1, -1, 1)}
PACKINGS = {"raw": "raw", "gzip": "gzip", "gz": "gzip", "bzip2": "bzip2", "bz2": "bzip2"}
PACKINGS |= dict.fromkeys(("ascii", "text", "txt"), "ascii")
MILLIMETRES = {"mm": 1.0, "millimeter": 1.0, "m": 1000.0, "cm": 10.0, "um": 0.001, "": 1.0}
SYNONYMS = {"datafile": "data file", "lineskip": "line skip", "byteskip": "byte skip"}
VECTORS = ("space directions", "space origin")
NUMBERS = {*VECTORS, "dimension", "sizes", "line skip", "byte skip", "measurement frame", "space dimension"}
PLAIN = re.compile(r"[ \t0-9a-zA-Z.,()+-]*")
MAX_LINES = 9999  # between header and voxels


def read_nrrd(path: Path, grid: VoxelGrid | None = None) -> StoredImage:
    """Read one image of three axes, or a segmentation with its layers, from `path`.

    Layers that do not overlap become one label image; a segmentation that was cropped is completed by what it says of
    its reference image, else by `grid`. Raises `InputDataError` with a sentence for whatever is wrong.
    """
    array, fields = nrrd_content(path)
    try:
        segments = segments_of(fields)
        layers = array.layers(path, None if segments else 1)
        if not segments:
            return StoredImage(layers[0], array.affine, digests=array.digests)
        labels, names = flattened(layers, segments)
    except ValueError as error:
        raise InputDataError(f"'{path}' {error}; export the segmentation again") from error
    return uncropped(StoredImage(labels, array.affine, names, array.digests), fields, grid, path)


def nrrd_content(path: Path) -> tuple[StoredArray, dict[str, Any]]:
    """Voxels of three axes in space and any others, and the header's fields and keys, which pynrrd parsed.

    Raises `InputDataError` with a sentence for whatever is wrong.
    """
    with opened(path) as file:
        fields = _fields(header_lines(file, path, "$"), path)
        affine, beside = _place(fields, path)
        values, digests = voxels_of(file, path, fields.get("data file"), _block(fields, path))
    return StoredArray(values, affine, beside, digests), fields


def _fields(lines: list[str], path: Path) -> dict[str, Any]:
    """The header's fields and keys, by pynrrd; one may be there twice, if both agree."""
    if not lines or not re.fullmatch(r"NRRD000[1-5]", lines[0]):
        raise InputDataError(f"'{path}' does not begin as an NRRD file does; export the image as NRRD or NIfTI")
    plain = []
    for line in lines[1:]:
        name, colon, value = line.partition(":")
        if not value.startswith("="):  # else it is a key
            name = SYNONYMS.get(name.strip().lower(), name.strip().lower())
        if name in NUMBERS and not PLAIN.fullmatch(value):  # Python reads 1_5 and digits of all scripts
            raise refused(path, name, value.strip(), "its numbers must be plain digits: correct it")
        if name in VECTORS:  # vectors without blanks; a bare nan, for an axis outside space, is no vector
            vectors = re.findall(r"\([^()]*\)|[^\s()]+", value.lower())
            value = " ".join("none" if each == "nan" else re.sub(r"\s+", "", each) for each in vectors)
        plain.append(f"{name}{colon}{value.strip()}")
    try:
        fields: dict[str, Any] = import_module("nrrd").read_header([lines[0], *dict.fromkeys(plain)])
    except Exception as error:  # pynrrd raises what numpy and Python raise
        flaw = printable(str(error)[:100])
        raise InputDataError(f"the header of '{path}' is no NRRD header: {flaw}; export the image again") from error
    for name in ("dimension", "sizes", "type", "encoding"):
        if name not in fields:
            raise refused(path, name, "missing", "export the image again")
    if min(fields["sizes"], default=0) < 1 or len(fields["sizes"]) != fields["dimension"]:
        raise refused(path, "sizes", fields["sizes"], f"{fields['dimension']} positive counts are needed: export again")
    return fields


def _block(fields: Mapping[str, Any], path: Path) -> VoxelBlock:
    """How the voxels are stored."""
    packing = PACKINGS.get(fields["encoding"].lower())
    if packing is None:
        raise refused(path, "encoding", fields["encoding"], "raw, gzip, bzip2 and ascii are read; save it with gzip")
    one = {name: str(fields[name]).lower() for name in ("type", "endian") if name in fields}
    one |= {"endian": "little"} if packing == "ascii" else {}
    try:
        none = {**one, "encoding": "raw", "dimension": 1, "sizes": np.zeros(1, dtype=int)}
        dtype = import_module("nrrd").read_data(none, io.BytesIO()).dtype
    except Exception as error:
        field = "endian" if "endian" in str(error) else "type"
        advice = "integers and floats of up to 64 bits, little or big, are read"
        raise refused(path, field, fields.get(field, "missing"), advice) from error
    skip, lines = fields.get("byte skip", 0), fields.get("line skip", 0)
    if not 0 <= lines <= MAX_LINES:
        raise refused(path, "line skip", lines, f"it must lie between 0 and {MAX_LINES}; export the image again")
    return VoxelBlock(tuple(int(n) for n in fields["sizes"]), dtype, packing, skip, lines)


def _place(fields: Mapping[str, Any], path: Path) -> tuple[NDArray[np.float64], tuple[int, ...]]:
    """The affine (4, 4) index -> RAS mm of the axes in space, and the axes that are not in it (layers, time).

    By `space`, `space directions` and `space origin`; a missing origin is zero, as ITK has it.
    """
    space = str(fields.get("space", "missing")).lower()
    timed = space.endswith("-time") or len(space) == 4
    signs, n = RAS_SIGNS.get(space.removesuffix("-time")[: 3 if len(space) == 4 else None]), 3 + timed
    if signs is None or "space directions" not in fields:
        raise refused(path, "space", space, "it does not say where right, front and head are; export it as LPS or RAS")
    vectors, origin = fields["space directions"], fields.get("space origin", np.zeros(n))
    if vectors.shape != (fields["dimension"], n) or origin.shape != (n,):
        raise refused(path, "space directions", vectors.tolist(), f"vectors of {n} numbers, one a size, are needed")
    beside = np.isnan(vectors).all(axis=1) | (timed & ~vectors[:, :3].any(axis=1))
    if np.count_nonzero(~beside) != 3 or vectors[~beside, 3:].any():
        raise refused(path, "space directions", vectors.tolist(), "three axes are needed; extract one volume")
    units = set(fields.get("space units", ["mm"])[:3])
    if len(units) != 1 or not units <= set(MILLIMETRES):
        raise refused(path, "space units", sorted(units), 'it must be "mm" "mm" "mm"; correct it')
    affine = np.eye(4)
    affine[:3, :3], affine[:3, 3] = vectors[~beside, :3].T, origin[:3]
    with np.errstate(all="ignore"):  # what is not finite is refused later, with its numbers
        affine[:3] *= np.array(signs)[:, None] * MILLIMETRES[units.pop()]
    return affine + 0.0, tuple(int(k) for k in np.flatnonzero(beside))  # no minus zero


register(ImageFormat("NRRD", (".nrrd", ".nhdr"), read_nrrd, read_on=read_nrrd))
