"""Displacements by digital volume correlation, with the error of each node: results of pyALDVC, .npz and .vti.

A displacement is that of a subset (see `subset_mean`). The standard deviation that is written is that of the grey
values' noise alone. On 9 simulated pairs (al-dvc 1.2.1; affine motion, and that of a block with a stiff ball; noise of
5 to 40 %, subsets of 16 and 24 voxels) errors are `UNDERSTATED` times as large, and `FLOOR_VOXELS` where there is none:
pooled over all, error over stated is 0.97, and 0.79 to 1.15 in one pair.
"""

from __future__ import annotations

import base64
import io
import json
import math
import re
import zipfile
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from palpate.errors import InputDataError
from palpate.images.input_file import whole_input
from palpate.images.named_labels import printable
from palpate.observation.contract import DataFile
from palpate.observation.point_table import PointTable, stated_sd

MOST_BYTES = 2**30
UNDERSTATED = 1.15
FLOOR_VOXELS = 0.006
VOXELS_APART = 8.0  # nodes of a .vti, which does not tell
CONVERGED = 0  # among the states of a node
MILLIMETRES = {"mm": 1.0, "um": 1e-3, "µm": 1e-3, "μm": 1e-3, "micron": 1e-3, "nm": 1e-6, "cm": 10.0, "m": 1e3}
UNREADABLE = (ValueError, LookupError, TypeError, OverflowError, EOFError, MemoryError, zipfile.BadZipFile)
VTK_WORDS = {"Float32": "<f4", "Float64": "<f8"}
ATTRIBUTE, DATA_ARRAY = re.compile(r'(\w+)="([^"]*)"'), re.compile(r"<DataArray\s([^>]*)>([^<]*)</DataArray>")


def read_dvc(file: DataFile) -> tuple[PointTable, tuple[float, float, float]]:
    """The valid nodes of a result of pyALDVC, and the edges (mm) of its subsets along x, y and z.

    A node is valid where its result is in the mask, has converged, is no outlier and has a standard deviation. Raises
    `InputDataError` for whatever is wrong.
    """
    path = file.paths[0]
    content, digest = whole_input(path, MOST_BYTES)
    try:
        return (_npz if path.suffix.lower() == ".npz" else _vti)(content, file, digest)
    except UNREADABLE as error:
        raise InputDataError(
            f"'{path}' is no result of pyALDVC ({type(error).__name__}: {printable(str(error)[:200])}); export it"
            " again, or write a .csv"
        ) from error


def _npz(content: bytes, file: DataFile, digest: str) -> tuple[PointTable, tuple[float, float, float]]:
    path = file.paths[0]
    archive = zipfile.ZipFile(io.BytesIO(content))
    if sum(entry.file_size for entry in archive.infolist()) > 4 * MOST_BYTES:
        raise InputDataError(f"'{path}' holds more than {4 * MOST_BYTES} bytes; export fewer fields")
    stored = np.load(io.BytesIO(content), allow_pickle=False)
    settings = json.loads(str(stored["para_json"]))
    unit = str(settings["units"]).strip()
    if unit not in MILLIMETRES:
        raise InputDataError(
            f"'{path}' has the length unit {printable(unit)!r}; set voxel_size and units (mm, um) in pyALDVC, and"
            " export it again"
        )
    voxel = MILLIMETRES[unit] * np.asarray(stored["voxel_size"], dtype=np.float64)
    numbers = _chain(stored, file)
    valid, variance = stored["node_valid"].astype(bool), np.zeros((len(stored["coordinates"]), 3))
    for k in numbers:  # from frame to frame errors add up
        valid &= (stored[f"status_{k}"] == CONVERGED) & ~np.asarray(stored.get(f"outlier_{k}", False), dtype=bool)
        variance += np.square(stored[f"U_std_{k}"], dtype=np.float64)
    name = f"U_accum_{numbers[0]}"
    moved = np.asarray(stored[name if name in stored else f"U_{numbers[0]}"], dtype=np.float64)
    errors = voxel * np.sqrt(UNDERSTATED**2 * variance + len(numbers) * FLOOR_VOXELS**2)
    places = voxel * np.asarray(stored["coordinates"], dtype=np.float64)
    x, y, z = (voxel * (np.asarray(settings["winsize"]) + 1)).tolist()  # a subset has its node's voxel, too
    return _table(places, voxel * moved, errors, valid, file, digest), (x, y, z)


def _chain(stored: Mapping[str, NDArray[Any]], file: DataFile) -> list[int]:
    """The frame that is asked for, and those between it and the first volume, by which it was found."""
    references = stored["ref_indices"].tolist()
    n, frame = len(references), file.frame or (1 if len(references) == 1 else file.state)
    if frame > n:
        raise InputDataError(
            f"'{file.paths[0]}' holds the frames 1 to {n}, not {frame}; name one as frame in [[data]] (default: state)"
        )
    chain = [frame]
    while (before := references[chain[-1] - 1]) > 0:
        if before >= chain[-1]:
            raise ValueError(f"frame {chain[-1]} was compared with frame {before}")
        chain.append(before)
    if len(chain) > 1 and f"U_accum_{frame}" not in stored:
        raise ValueError(f"frame {frame} has no displacement from the first volume")
    return chain


def _vti(content: bytes, file: DataFile, digest: str) -> tuple[PointTable, tuple[float, float, float]]:
    """The file has no unit, so millimetres, and not the size of a subset, so twice the distance of nodes."""
    text = content.decode("ascii")
    (grid,) = (dict(ATTRIBUTE.findall(found[1])) for found in re.finditer(r"<ImageData\s([^>]*)>", text))
    arrays = {
        (found := dict(ATTRIBUTE.findall(head)))["Name"]: (found, body) for head, body in DATA_ARRAY.findall(text)
    }
    extent = [int(word) for word in grid["WholeExtent"].split()]
    spacing, origin = (np.array([float(word) for word in grid[name].split()]) for name in ("Spacing", "Origin"))
    shape = [high - low + 1 for low, high in zip(extent[4::-2], extent[5::-2], strict=True)]
    n = math.prod(shape)
    if spacing.shape != (3,) or origin.shape != (3,) or len(shape) != 3 or not 0 < n < len(content):
        raise ValueError(f"a grid of {shape} nodes")
    moved, sd, valid = (
        _vtk_array(*arrays[name], n, width)
        for name, width in (("displacement", 3), ("displacement_std", 3), ("node_valid", 1))
    )
    index = np.stack(np.meshgrid(*map(np.arange, shape), indexing="ij"), axis=-1).reshape(-1, 3)
    places = origin + spacing * (index[:, ::-1] + np.array(extent[::2]))
    errors = np.hypot(UNDERSTATED * sd, FLOOR_VOXELS / VOXELS_APART * spacing)
    x, y, z = (2.0 * spacing).tolist()
    return _table(places, moved, errors, valid.ravel() > 0.5, file, digest), (x, y, z)


def _vtk_array(head: Mapping[str, str], body: str, n: int, width: int) -> NDArray[np.float64]:
    """An array (n, width) that stands inline in base64, behind its length."""
    if head["format"] != "binary" or int(head["NumberOfComponents"]) != width:
        raise ValueError(f"'{head['Name']}' does not stand inline with {width} components")
    words, content = np.dtype(VTK_WORDS[head["type"]]), base64.b64decode(body)
    values = np.frombuffer(content, words, n * width, len(content) - n * width * words.itemsize)
    return values.reshape(n, width).astype(np.float64)


def _table(
    places: NDArray[np.float64],
    moved: NDArray[np.float64],
    sd: NDArray[np.float64],
    valid: NDArray[np.bool_],
    file: DataFile,
    digest: str,
) -> PointTable:
    """The valid ones of nodes (n, 3) mm; moved, sd (n, 3) mm: their displacements and errors, if the case has none."""
    valid = valid & np.isfinite(moved).all(axis=1) & (np.isfinite(sd) & (sd > 0.0)).all(axis=1)
    count = int(valid.sum())
    if not count:
        raise InputDataError(f"none of the {len(valid)} nodes of '{file.paths[0]}' is valid; correct the correlation")
    sd = sd[valid] if file.sd_mm is None else stated_sd(file, count)
    remark = f"{len(valid) - count} of {len(valid)} nodes are not valid and left out" if count < len(valid) else ""
    before = places[valid]
    return PointTable(before, before + moved[valid], sd, ("",) * count, (digest,), remark=remark)
