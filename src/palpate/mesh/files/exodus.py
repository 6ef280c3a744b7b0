"""Meshes of Exodus II, netCDF classic or 4: element blocks, side sets and node sets, by name and number."""

from __future__ import annotations

import io
import re
from importlib import import_module
from typing import Any

import numpy as np
from scipy.io import netcdf_file

from palpate.errors import InputDataError
from palpate.mesh.files.elements import CORNERS, MOST_BYTES, Block, Elements, Name

WANTED = re.compile(r"coord[xyz]?$|connect\d+$|(eb|ss|ns)_(prop1|names)$|(elem|side)_ss\d+$|node_ns\d+$")
SIDES = np.array([[0, 1, 3], [1, 2, 3], [0, 3, 2], [0, 2, 1]])
KINDS = {("TET", 4): "tetra", ("TET", 10): "tetra10", ("TRI", 3): "triangle", ("TRI", 6): "triangle6"}
HOLLOW = ("TRI", "SHE", "QUA", "BAR", "BEA", "TRU", "SPH", "CIR", "EDG", "POI", "NOD")


def read_exodus(content: bytes, _: str | None) -> Elements:
    """Elements with the blocks, side sets and node sets; raises `InputDataError` for what is no such file."""
    found, kinds = _variables(content)
    axes = [found[f"coord{axis}"] for axis in "xyz"] if "coordx" in found else found["coord"]
    blocks, corners = list[Block](), [np.zeros((0, 4), dtype=np.int64)]
    for number, names in _named(found, "eb"):
        rows = found.get(f"connect{number}", np.ones((0, 1))).astype(np.int64) - 1
        start = kinds.get(f"connect{number}", "").upper()[:3]
        other = "line" if start in HOLLOW else f"{start} of {rows.shape[1]} nodes"
        blocks.append((KINDS.get((start, rows.shape[1]), other), rows, names))
        n = CORNERS.get(blocks[-1][0], 0)
        corners.append(np.pad(rows[:, :n], ((0, 0), (0, 4 - n)), constant_values=-1))
    every = np.concatenate(corners)
    for number, names in _named(found, "ss"):
        elements, sides = (found[f"{of}_ss{number}"].astype(np.int64) - 1 for of in ("elem", "side"))
        of_sides = every[elements]
        solid, shell = of_sides[:, 3] >= 0, (of_sides[:, 0] >= 0) & (of_sides[:, 3] < 0)
        blocks.append(("triangle", np.take_along_axis(of_sides[solid], SIDES[sides[solid]], axis=1), names))
        blocks.append(("triangle", of_sides[shell, :3], names))
    for number, names in _named(found, "ns"):
        blocks.append(("node", found.get(f"node_ns{number}", np.ones(0)).astype(np.int64)[:, None] - 1, names))
    return Elements(np.stack([np.asarray(axis, dtype=float) for axis in axes], axis=1), blocks)


def _named(found: dict[str, Any], of: str) -> list[tuple[int, set[Name]]]:
    """Each block or set ("eb", "ss", "ns"), counted from 1, with its number in the file and its name, if it has one."""
    letters = found.get(f"{of}_names", np.zeros((len(found.get(f"{of}_prop1", ())), 0), dtype="S1"))
    numbers = found.get(f"{of}_prop1", 1 + np.arange(len(letters)))
    texts = [b"".join(row.tolist()).split(b"\0")[0].decode(errors="replace").strip() for row in letters]
    return [(n, {int(i), t or int(i)}) for n, (i, t) in enumerate(zip(numbers, texts, strict=True), start=1)]


def _variables(content: bytes) -> tuple[dict[str, Any], dict[str, str]]:
    """Arrays by name, and the kind of elements by that of their array."""
    classic = content.startswith(b"CDF")
    opened: Any = netcdf_file if classic else import_module("h5py").File
    with opened(io.BytesIO(content)) as file:
        wanted = {name: data for name, data in getattr(file, "variables", file).items() if WANTED.match(name)}
        if sum(8.0 * np.prod(data.shape) for data in wanted.values()) > MOST_BYTES:
            raise InputDataError(f"its arrays have over {MOST_BYTES / 2**30:.0f} GB")
        kinds = {name: (vars(data) if classic else data.attrs).get("elem_type", b"") for name, data in wanted.items()}
        arrays = {name: np.array(data[:]) for name, data in wanted.items()}
    return arrays, {name: kind.decode() if isinstance(kind, bytes) else str(kind) for name, kind in kinds.items()}
