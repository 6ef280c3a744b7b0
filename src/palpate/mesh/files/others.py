"""Meshes of the formats that meshio reads, with the numbers and names of their groups."""

from __future__ import annotations

import contextlib
import io
import re
from collections.abc import Callable, Collection
from importlib import import_module
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any
from xml.parsers import expat

import numpy as np

from palpate.errors import ConfigurationError, InputDataError
from palpate.images.input_file import beside
from palpate.mesh.files.elements import CORNERS, Block, Elements, Name

GROUPS = ["tissue", "label", "region", "medit:ref", "gmsh:physical", "materialid", "material", "cellentityid"]
GROUPS += ["regionid", "tetgen:ref", "netgen:index", "nastran:ref", "avsucd:material", "ugrid:ref", "su2:tag"]
Names = Callable[[int, int], Collection[Name]]  # the groups of elements of a dimension with a number


def read_by_meshio(path: Path, data: str | None) -> Elements:
    """Elements with the groups that cell data number, by default the first of the usual names.

    Raises `InputDataError` for what is no such file, `ConfigurationError` where meshio is not installed.
    """
    if path.suffix.lower() in (".xdmf", ".xmf"):
        _refuse_elsewhere(path)
    mesh = _read(path)
    plain = {name.casefold().removesuffix("s"): name for name in mesh.cell_data}
    return _elements(mesh, data or next((plain[name] for name in GROUPS if name in plain), None))


def _refuse_elsewhere(path: Path) -> None:
    """Raise `InputDataError` where an XDMF file names a file outside of its folder; meshio would read any."""
    elements, parser = [("", list[str]())], expat.ParserCreate()
    parser.StartElementHandler = lambda _, attributes: elements.append((attributes.get("Format", ""), []))
    parser.CharacterDataHandler = lambda text: elements[-1][1].extend([text])
    parser.Parse(path.read_bytes(), True)
    for kind, texts in elements:
        if kind in ("HDF", "Binary"):
            name = "".join(texts).strip()
            beside(path, name.partition(":")[0] if kind == "HDF" else str(Path(name).resolve()))


def read_med(content: bytes, data: str | None) -> Elements:
    """The same of MED's, whose elements and nodes have the groups of their family."""
    whole = io.BytesIO(content)
    with import_module("h5py").File(whole, "r+") as file:
        families = [own for mesh in file.get("FAS", {}).values() for of in mesh.values() for own in of.values()]
        for family in (family for family in families if "GRO" not in family):  # which meshio takes for granted
            family.create_group("GRO").attrs["NBR"] = 0
            family["GRO"]["NOM"] = np.zeros((0, 80), dtype=np.int8)
    mesh = _read(whole, "med")
    if data is not None:
        return _elements(mesh, data)
    return _elements(mesh, "cell_tags" if mesh.cell_tags else None, lambda _, number: mesh.cell_tags.get(number, ()))


def read_gmsh(content: bytes, data: str | None) -> Elements:
    """The same of gmsh's: all groups of an element, of which meshio gives the first, and none where any has none."""
    head = re.search(rb"\$MeshFormat\s+(2|4\.1)\S*\s+([01])", content)
    if head is None or b"$PartitionedEntities" in content:
        raise InputDataError("it is partitioned, or of an unsupported version; save it as one file of version 4.1")
    named = re.findall(rb'(\d)\s+(-?\d+)\s+"([^"\n]*)"', content.partition(b"$EndPhysicalNames")[0])
    names = {(int(d), abs(int(tag))): text.decode(errors="replace") for d, tag, text in named}
    tags = _entities(content, binary=head[2] == b"1") if head[1] == b"4.1" else None
    with TemporaryDirectory() as folder:
        path = Path(folder, "mesh.msh")
        path.write_bytes(re.sub(rb"\$(End)?Entities", rb"$\1NotRead_", content, count=2))
        mesh = _read(path)

    def groups(dimension: int, number: int) -> Collection[Name]:
        """Numbers and names of the physical groups; of version 4.1 by the entity."""
        own = [abs(number)] * bool(number) if tags is None else tags.get((dimension, number), [])
        return {name for tag in own for name in (tag, names.get((dimension, tag), tag))}

    if data not in (None, "gmsh:physical"):
        return _elements(mesh, data)
    key = "gmsh:physical" if tags is None else "gmsh:geometrical"
    return _elements(mesh, key if key in mesh.cell_data else None, groups)


def _read(source: Path | io.BytesIO, kind: str | None = None) -> Any:
    try:
        meshio = import_module("meshio")
    except ImportError as error:
        raise ConfigurationError("meshio reads meshes of this kind: pip install 'palpate[mesh]'") from error
    try:
        with contextlib.redirect_stdout(io.StringIO()) as said:  # it prints why it does not read a file
            return meshio.read(source, kind)
    except SystemExit as error:  # and ends the program
        raise InputDataError(
            f"meshio says: {said.getvalue().strip()}; export it as .msh, or as .vtu without field data"
        ) from error


def _elements(mesh: Any, key: str | None, names: Names = lambda _, number: (number,)) -> Elements:
    """What meshio has read, with the groups that the cell data `key` number, and MED's groups of nodes."""
    blocks = list[Block]()
    about = f"its cell data, of which tissue_data may name one, are {sorted(mesh.cell_data)}" if mesh.cell_data else ""
    if key is not None and key not in mesh.cell_data:
        raise InputDataError(f"it has no cell data '{key}'; {about}")
    for number, (kind, data) in enumerate((cells.type, cells.data) for cells in mesh.cells):
        if key is None or kind not in CORNERS:
            blocks.append((kind, np.asarray(data if kind in CORNERS else [()] * len(data), int), ()))
            continue
        values = mesh.cell_data[key][number]
        if np.ndim(values) > 1 or not np.array_equal(values, np.rint(values)):
            raise InputDataError(
                f"its cell data '{key}' are not one whole number for each cell; name others in tissue_data"
            )
        for value in np.unique(values):
            blocks.append((kind, np.asarray(data[values == value], int), names(CORNERS[kind] - 1, int(value))))
    for tag, families in getattr(mesh, "point_tags", {}).items():
        blocks.append(("node", np.argwhere(mesh.point_data["point_tags"] == tag), families))
    return Elements(np.asarray(mesh.points, dtype=float), blocks, about)


def _entities(content: bytes, *, binary: bool) -> dict[tuple[int, int], list[int]]:
    """The physical groups of gmsh's entities, by their dimension and number."""
    body = content.partition(b"$Entities")[2].partition(b"$EndEntities")[0][1:]
    stream, words, found = io.BytesIO(body), iter(body.split()), {}

    def take(kind: str, count: int = 1) -> list[int]:
        """The next numbers of a kind."""
        if binary:
            return [int(x) for x in np.frombuffer(stream.read(count * np.dtype(kind).itemsize), kind)]
        return [int(float(next(words))) for _ in range(count)]

    for dimension, count in enumerate(take("u8", 4) if body else ()):
        for _ in range(count):
            tag, _ = take("i4")[0], take("f8", 6 if dimension else 3)
            found[dimension, tag] = [abs(group) for group in take("i4", take("u8")[0])]
            take("i4", take("u8")[0] if dimension else 0)
    return found
