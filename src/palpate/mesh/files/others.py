"""Meshes of the formats that meshio reads, with the numbers and names of their groups."""

from __future__ import annotations

import contextlib
import io
import re
import tempfile
from collections import defaultdict
from collections.abc import Callable, Collection
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np

from palpate.errors import ConfigurationError, InputDataError
from palpate.mesh.files.elements import Elements, Name, Numbers

GROUPS = ["tissue", "label", "region", "medit:ref", "gmsh:physical", "materialid", "material", "cellentityid"]
GROUPS += ["regionid", "tetgen:ref", "netgen:index", "nastran:ref", "avsucd:material", "ugrid:ref", "su2:tag"]
DIMENSIONS = {"tetra": 3, "tetra10": 3, "triangle": 2, "triangle6": 2}
Names = Callable[[int, int], Collection[Name]]  # the groups of elements of a dimension with a number


def read_by_meshio(path: Path, data: str | None) -> Elements:
    """Elements with the groups that cell data number (by default the first of the usual names), and named sets.

    Raises `InputDataError` for what is no such file, `ConfigurationError` where meshio is not installed.
    """
    mesh = _read(path)
    plain = {name.casefold().removesuffix("s"): name for name in mesh.cell_data}
    key = data or next((plain[name] for name in GROUPS if name in plain), None)
    return _elements(mesh, key, lambda _, number: (number,))


def read_med(content: bytes, data: str | None) -> Elements:
    """The same of MED's, whose elements have the groups of their family."""
    mesh = _read_copy(content, ".med")
    if data is not None:
        return _elements(mesh, data, lambda _, number: (number,))
    return _elements(mesh, "cell_tags" if mesh.cell_tags else None, lambda _, number: mesh.cell_tags.get(number, ()))


def read_gmsh(content: bytes, data: str | None) -> Elements:
    """The same of gmsh's: all groups of an element, of which meshio gives the first, and none where any has none."""
    head = re.search(rb"\$MeshFormat\s+(2|4\.1)\S*\s+([01])", content)
    if head is None or b"$PartitionedEntities" in content:
        raise InputDataError("it is partitioned, or of a version that is not read; save it whole, as version 4.1")
    named = re.findall(rb'(\d)\s+(-?\d+)\s+"([^"\n]*)"', content.partition(b"$EndPhysicalNames")[0])
    names = {(int(d), abs(int(tag))): text.decode(errors="replace") for d, tag, text in named}
    tags = _entities(content, binary=head[2] == b"1") if head[1] == b"4.1" else None
    mesh = _read_copy(
        content.replace(b"$Entities", b"$NotRead_", 1).replace(b"$EndEntities", b"$EndNotRead_", 1), ".msh"
    )

    def groups(dimension: int, number: int) -> Collection[Name]:
        """Numbers and names of the physical groups; of version 4.1 by the entity."""
        own = [abs(number)] * bool(number) if tags is None else tags.get((dimension, number), [])
        return {name for tag in own for name in (tag, names.get((dimension, tag), tag))}

    if data not in (None, "gmsh:physical"):
        return _elements(mesh, data, lambda _, number: (number,))
    key = "gmsh:physical" if tags is None else "gmsh:geometrical"
    return _elements(mesh, key if key in mesh.cell_data else None, groups)


def _read_copy(content: bytes, ending: str) -> Any:
    """What meshio reads of a copy of the file, in which MED's families without a group have an empty list of them."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / f"mesh{ending}"
        path.write_bytes(content)
        if ending == ".med":
            with import_module("h5py").File(path, "r+") as file:
                families = [own for mesh in file.get("FAS", {}).values() for of in mesh.values() for own in of.values()]
                for family in (family for family in families if "GRO" not in family):
                    family.create_group("GRO").attrs["NBR"] = 0
                    family["GRO"]["NOM"] = np.zeros((0, 80), dtype=np.int8)
        return _read(path)


def _read(path: Path) -> Any:
    try:
        meshio = import_module("meshio")
    except ImportError as error:
        raise ConfigurationError(f"meshio reads '{path.name}': pip install 'palpate[mesh]'") from error
    try:
        with contextlib.redirect_stdout(io.StringIO()) as said:  # it prints why it does not read a file
            return meshio.read(path)
    except SystemExit as error:  # and ends the program
        raise InputDataError(
            f"meshio does not read it: {said.getvalue().strip()}; export it as .msh, or as .vtu without field data"
        ) from error


def _elements(mesh: Any, key: str | None, names: Names) -> Elements:
    """What meshio has read, with the groups that the cell data `key` number, the sets, and MED's groups of nodes."""
    blocks = [(b.type, np.asarray(b.data if b.type in DIMENSIONS else [()] * len(b.data), int)) for b in mesh.cells]
    firsts = np.cumsum([0, *(len(rows) for _, rows in blocks)])
    sets, point_sets = defaultdict[Name, list[Numbers]](list), defaultdict[Name, list[Numbers]](list)
    if key is not None and key not in mesh.cell_data:
        raise InputDataError(f"it has no cell data '{key}'; tissue_data may name one of {sorted(mesh.cell_data)}")
    for first, (kind, _), data in zip(firsts, blocks, mesh.cell_data.get(key, ()), strict=False):
        values = np.unique(data) if kind in DIMENSIONS else np.zeros(0)
        if not np.array_equal(values, np.rint(values)) or np.ndim(data) > 1:
            raise InputDataError(f"its cell data '{key}' are no whole numbers, one a cell; name others in tissue_data")
        for value in values:
            for name in names(DIMENSIONS[kind], int(value)):
                sets[name].append(first + np.flatnonzero(data == value))
    for name, members in mesh.cell_sets.items():
        sets[name] += [n + np.asarray(own, int) for n, own in zip(firsts, members, strict=False) if own is not None]
    for name, points in mesh.point_sets.items():
        point_sets[name].append(np.asarray(points, dtype=np.int64))
    for tag, families in getattr(mesh, "point_tags", {}).items():
        for name in families:
            point_sets[name].append(np.flatnonzero(mesh.point_data["point_tags"] == tag))
    about = f"its cell data, of which tissue_data may name one, are {sorted(mesh.cell_data)}" if mesh.cell_data else ""
    return Elements(np.asarray(mesh.points, dtype=float), blocks, sets, point_sets, about)


def _entities(content: bytes, *, binary: bool) -> dict[tuple[int, int], list[int]]:
    """The physical groups of gmsh's entities, by their dimension and number."""
    body, at, found = content.partition(b"$Entities")[2].partition(b"$EndEntities")[0][1:], 0, {}
    words = [] if binary else [float(word) for word in body.split()]

    def take(kind: str, count: int = 1) -> list[int]:
        nonlocal at
        first, at = at, at + count * (np.dtype(kind).itemsize if binary else 1)
        return np.frombuffer(body, kind, count, first).tolist() if binary else [int(x) for x in words[first:at]]

    for dimension, count in enumerate(take("u8", 4) if body else ()):
        for _ in range(count):
            tag, _ = take("i4")[0], take("f8", 6 if dimension else 3)
            found[dimension, tag] = [abs(group) for group in take("i4", take("u8")[0])]
            take("i4", take("u8")[0] if dimension else 0)
    return found
