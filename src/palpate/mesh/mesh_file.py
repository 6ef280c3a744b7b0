"""A tetrahedral mesh that somebody else made: what meshio reads, with its tissues and named surfaces."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from palpate.errors import ConfigurationError, GeometryError, InputDataError
from palpate.images.input_file import open_input
from palpate.images.tissue import Tissue
from palpate.mesh.tet_mesh import TetMesh
from palpate.mesh.tetrahedralise import boundary_of

MOST_BYTES = 4 * 2**30
TETRAHEDRA, TRIANGLES = ("tetra", "tetra10"), ("triangle", "triangle6")
GROUPS = ("tissue", "label", "region", "medit:ref", "gmsh:physical", "MaterialID", "material", "CellEntityIds")
WHOLE = "boundary"
PLANES = tuple(f"{axis}_{end}" for axis in "xyz" for end in ("min", "max"))
LEANS_DEG = 15.0  # of a surface against the plane that it is named by
SLIVER = 1e-9  # volume over the cube of the longest edge


@dataclass(frozen=True, slots=True)
class MeshFile:
    """Nodes (n, 3) mm, tets (n_tets, 4) of positive volume, group (n_tets,) of each; names of groups, where it has any.

    surfaces: triangles (n_faces, 3) by the name of their group; digest: SHA-256 of the file.
    """

    nodes: NDArray[np.float64]
    tets: NDArray[np.int64]
    group: NDArray[np.int64]
    names: Mapping[int, str] = field(default_factory=dict)
    surfaces: Mapping[str, NDArray[np.int64]] = field(default_factory=dict)
    digest: str = ""


def read_mesh_file(path: Path, *, data: str | None = None) -> MeshFile:
    """Read tetrahedra of 4 or 10 nodes (of the latter the corners) and their groups; RAS mm.

    data: the cell data that tell the tissue; by default the first of the usual names, or one group, 1. Raises
    `InputDataError` for a file that holds no such mesh, `ConfigurationError` where meshio is not installed.
    """
    try:
        meshio = import_module("meshio")
    except ImportError as error:
        raise ConfigurationError(f"meshio reads '{path}': pip install 'palpate[mesh]'") from error
    try:
        with open_input(path) as file:
            if file.n_bytes > MOST_BYTES:
                raise InputDataError(f"'{path}' has {file.n_bytes / 2**30:.1f} GB; meshes of up to 4 GB are read")
            digest = file.sha256()
    except (OSError, ValueError) as error:
        raise InputDataError(f"'{path}' cannot be read: {error}; check the path") from error
    try:
        mesh = meshio.read(path)
    except SystemExit as error:  # meshio ends the program for some files
        raise InputDataError(f"'{path}' is no mesh that meshio reads; export it as .vtu or .msh") from error
    except Exception as error:  # meshio raises what its formats raise
        raise InputDataError(f"'{path}' is no mesh that meshio reads: {type(error).__name__}: {error}") from error
    nodes = np.asarray(mesh.points, dtype=np.float64)
    chosen = [i for i, block in enumerate(mesh.cells) if block.type in TETRAHEDRA]
    if not chosen or nodes.ndim != 2 or nodes.shape[1] != 3:
        kinds = sorted({block.type for block in mesh.cells})
        raise InputDataError(f"'{path}' holds {kinds} and no tetrahedra; export a volume mesh of 4 or 10 nodes a cell")
    tets = np.concatenate([np.asarray(mesh.cells[i].data)[:, :4] for i in chosen]).astype(np.int64)
    group = _groups(mesh, chosen, data, path)
    of_tets, of_faces = (
        {int(ids[0]): str(name)[:200] for name, ids in mesh.field_data.items() if len(ids) > 1 and ids[1] == dimension}
        for dimension in (3, 2)
    )
    nodes, tets = _sound(nodes, tets, path)
    parts: dict[str, list[NDArray[np.int64]]] = {}
    for i, block in enumerate(mesh.cells):
        if block.type in TRIANGLES and "gmsh:physical" in mesh.cell_data:
            numbers = np.asarray(mesh.cell_data["gmsh:physical"][i]).astype(np.int64)
            for number in np.unique(numbers).tolist():
                own = np.asarray(block.data)[numbers == number, :3].astype(np.int64)
                parts.setdefault(of_faces.get(number, str(number)), []).append(own)
    surfaces = {name: np.concatenate(own) for name, own in parts.items()}
    return MeshFile(nodes, tets, group, of_tets, surfaces, digest)


def _groups(mesh: Any, chosen: Sequence[int], data: str | None, path: Path) -> NDArray[np.int64]:
    """The group (n_tets,) of each tetrahedron."""
    known = mesh.cell_data
    key = data or next((name for name in GROUPS if name in known), None)
    if key is None:
        return np.ones(sum(len(mesh.cells[i].data) for i in chosen), dtype=np.int64)
    if key not in known:
        raise InputDataError(f"'{path}' has no cell data '{key}'; name one of {sorted(known)}")
    values = np.concatenate([np.asarray(known[key][i]).ravel() for i in chosen])
    if not np.array_equal(values, np.rint(values)):
        raise InputDataError(f"the cell data '{key}' of '{path}' are no whole numbers; name others in tissue_data")
    return values.astype(np.int64)


def _sound(
    nodes: NDArray[np.float64], tets: NDArray[np.int64], path: Path
) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Used nodes alone, and tetrahedra turned to a positive volume; `InputDataError` for what is no mesh."""
    if len(tets) == 0 or tets.min() < 0 or tets.max() >= len(nodes):
        raise InputDataError(
            f"the tetrahedra of '{path}' name nodes that it has not ({len(nodes)} nodes); export it again"
        )
    used, places = np.unique(tets, return_inverse=True)
    nodes, tets = nodes[used], places.reshape(tets.shape).astype(np.int64)
    if not np.isfinite(nodes).all():
        raise InputDataError(f"a node of '{path}' has a coordinate that is no number; export it again")
    corners = nodes[tets]
    volumes = np.linalg.det(corners[:, 1:] - corners[:, :1]) / 6.0
    longest = np.linalg.norm(corners[:, :, None] - corners[:, None], axis=3).max(axis=(1, 2))
    flat = np.flatnonzero(np.abs(volumes) <= SLIVER * longest**3)
    if len(flat):
        place = np.round(corners[flat[0]].mean(axis=0), 2).tolist()
        raise InputDataError(
            f"{len(flat)} tetrahedra of '{path}' have no volume, the first at {place} mm; repair it, by Mmg or gmsh"
        )
    tets = np.where(volumes[:, None] < 0.0, tets[:, [0, 2, 1, 3]], tets)
    return nodes, tets


def plane_faces(
    nodes: NDArray[np.float64], faces: NDArray[np.int64], plane: str, within_mm: float
) -> NDArray[np.bool_]:
    """Which faces (n_faces, 3) lie within so many mm of a plane of `PLANES`, or on the `WHOLE` boundary.

    Raises `GeometryError` where they lean against it, as the part of a bent tip does that reaches furthest.
    """
    if plane == WHOLE:
        return np.ones(len(faces), dtype=bool)
    axis, end = "xyz".index(plane[0]), plane[2:]
    along = nodes[:, axis] if end == "max" else -nodes[:, axis]
    found = np.asarray(along[faces].min(axis=1) >= along.max() - within_mm)
    a, b, c = np.moveaxis(nodes[faces[found]], 1, 0)
    area = np.abs(np.cross(b - a, c - a).sum(axis=0))
    lean = float(np.degrees(np.arccos(min(area[axis] / max(float(np.linalg.norm(area)), 1e-300), 1.0))))
    if found.any() and lean > LEANS_DEG:
        raise GeometryError(
            f"the faces within {within_mm:g} mm of {plane} lean against that plane by {lean:.0f} degrees: they are part"
            " of a surface that does not lie along it; name the surface by a group of faces of the mesh's file"
        )
    return found


def body_mesh(
    file: MeshFile,
    tissues: Sequence[Tissue],
    region: NDArray[np.int64],
    surfaces: Mapping[str, NDArray[np.bool_]],
    beyond: int,
) -> TetMesh:
    """The mesh of a file with tissues region (n_tets,), behind whose boundary faces hollow tissues lie.

    surfaces: boundary faces (n_boundary,) by the name of the hollow tissue behind them, the first one counts where two
    have a face; beyond: number of that behind all others. Raises `GeometryError` for a surface without a face.
    """
    boundary = boundary_of(file.tets)
    behind = np.full(len(boundary), beyond)
    names = [tissue.name for tissue in tissues]
    for name, faces in list(surfaces.items())[::-1]:
        if not faces.any():
            raise GeometryError(
                f"the surface '{name}' has no face of the mesh's boundary; make within_mm larger, or name another"
            )
        behind[faces] = names.index(name)
    covered = [name for name in surfaces if not np.any(behind == names.index(name))]
    if covered:
        raise GeometryError(
            f"all faces of the surface '{covered[0]}' belong to surfaces that are named before it; name it first, or"
            " leave it out"
        )
    return TetMesh(file.nodes, file.tets, region, boundary, behind, tuple(tissues))
