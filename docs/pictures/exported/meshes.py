"""Meshes of solvers as PyVista's: CalculiX' .frd, FEBio's .feb, gmsh's .msh, the arrays for SOFA.

Each is a grid with cells `tissue` (a name) and points `displacement_mm` where the file has them.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any
from xml.etree import ElementTree as ET

import numpy as np
import pyvista
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]
TETRAHEDRON = {4: pyvista.CellType.TETRA, 10: pyvista.CellType.QUADRATIC_TETRA}


def tetrahedra(points: Floats, cells: Integers, tissues: NDArray[np.str_]) -> pyvista.UnstructuredGrid:
    """A grid of tetrahedra of one order, corners and edges as VTK counts them."""
    grid = pyvista.UnstructuredGrid({TETRAHEDRON[cells.shape[1]]: cells}, points)
    grid.cell_data["tissue"] = tissues
    return grid


def calculix(path: Path) -> pyvista.UnstructuredGrid:
    """What CalculiX wrote: its own nodes and elements, the displacements of the last increment; an id has ten columns.

    Materials stand by their numbers in the elements and by their names in the head.
    """
    names: dict[int, str] = {}
    points: dict[int, list[float]] = {}
    cells: list[list[int]] = []
    materials: list[int] = []
    displacements: dict[int, list[float]] = {}
    section = ""
    for line in path.read_text(encoding="ascii").splitlines():
        start = line[:5].strip()
        if line.startswith("    1UMAT"):
            names[int(line[9:14])] = line[14:].strip().lower()
        elif start in ("2", "3") or line.startswith(" -4"):
            section = line.split()[1] if line.startswith(" -4") else line[4:6]
        elif line.startswith(" -1") and section in ("2C", "DISP"):
            into = points if section == "2C" else displacements
            into[int(line[3:13])] = [float(line[at : at + 12]) for at in range(13, 49, 12)]
        elif line.startswith(" -1") and section == "3C":
            materials.append(int(line[23:28]))
        elif line.startswith(" -2") and section == "3C":
            cells.append([int(line[at : at + 10]) for at in range(3, len(line.rstrip()), 10)])
    ids = np.array(sorted(points))
    grid = tetrahedra(
        np.array([points[i] for i in ids]),
        np.searchsorted(ids, np.array(cells)),
        np.array([names[number] for number in materials]),
    )
    grid.point_data["displacement_mm"] = np.array([displacements[i] for i in ids])
    return grid


def febio(path: Path) -> tuple[pyvista.UnstructuredGrid, dict[str, str], pyvista.PolyData]:
    """Element domains, material of each as words, and the nodes that are moved, with by how much in the last step."""
    root = ET.parse(path).getroot()  # noqa: S314 - our own export
    points = np.array(
        [[float(x) for x in (node.text or "").split(",")] for node in root.iter("node") if "id" in node.attrib]
    )
    blocks = {str(part.get("name")): np.array([_integers(e) for e in part]) - 1 for part in root.iter("Elements")}
    names = np.repeat(list(blocks), [len(block) for block in blocks.values()])
    grid = tetrahedra(points, np.concatenate(list(blocks.values())), names)
    words = {
        str(material.get("name")): f"{material.get('type')}, E = {float(material.findtext('E', 'nan')):.1f} kPa"
        for material in root.iter("material")
    }
    materials = {str(domain.get("name")): words[str(domain.get("mat"))] for domain in root.iter("SolidDomain")}
    (prescribed,) = (_integers(nodes) for nodes in root.iter("NodeSet") if nodes.get("name") == "prescribed")
    cloud = pyvista.PolyData(points[np.array(prescribed) - 1])
    last = [data for data in root.iter("NodeData") if data.get("node_set") == "prescribed"][-3:]
    cloud.point_data["displacement_mm"] = np.array([[float(node.text or 0) for node in data] for data in last]).T
    return grid, materials, cloud


def _integers(element: ET.Element) -> list[int]:
    return [int(x) for x in (element.text or "").split(",")]


def gmsh(path: Path) -> tuple[pyvista.UnstructuredGrid, dict[str, pyvista.PolyData]]:
    """Physical volumes with the view of displacements, and physical surfaces by name, as gmsh itself reads them."""
    import gmsh as module  # not at the top: this function's name is the page's

    module.initialize()
    try:
        module.option.setNumber("General.Terminal", 0)
        module.open(str(path))
        tags, coordinates, _ = module.model.mesh.getNodes()
        order = np.argsort(tags)
        tags, points = tags[order], coordinates.reshape(-1, 3)[order]
        groups = {
            (dimension, module.model.getPhysicalName(dimension, tag)): _elements(module, dimension, tag)
            for dimension, tag in module.model.getPhysicalGroups()
        }
        views = {module.option.getString(f"View[{i}].Name"): tag for i, tag in enumerate(module.view.getTags())}
        step = int(module.view.option.getNumber(views["displacement_mm"], "NbTimeStep")) - 1
        _, nodes, moved, _, _ = module.view.getModelData(views["displacement_mm"], step)
    finally:
        module.finalize()
    volumes = {name: np.searchsorted(tags, cells) for (dimension, name), cells in groups.items() if dimension == 3}
    cells = np.concatenate(list(volumes.values()))
    if cells.shape[1] == 10:
        cells = cells[:, [0, 1, 2, 3, 4, 5, 6, 7, 9, 8]]  # gmsh's last two edges are VTK's the other way round
    grid = tetrahedra(points, cells, np.repeat(list(volumes), [len(block) for block in volumes.values()]))
    displacement = np.zeros_like(points)
    displacement[np.searchsorted(tags, nodes)] = np.array(moved)
    grid.point_data["displacement_mm"] = displacement
    surfaces = {
        name: pyvista.PolyData.from_regular_faces(points, np.searchsorted(tags, faces[:, :3])).clean()
        for (dimension, name), faces in groups.items()
        if dimension == 2
    }
    return grid, surfaces


def _elements(module: Any, dimension: int, tag: int) -> Integers:
    """Node tags (elements, nodes of one) of a physical group of gmsh's model."""
    found = []
    for entity in module.model.getEntitiesForPhysicalGroup(dimension, tag):
        for kind, nodes in zip(*module.model.mesh.getElements(dimension, entity)[::2], strict=True):
            found.append(np.array(nodes).reshape(-1, module.model.mesh.getElementProperties(kind)[3]))
    return np.concatenate(found)
