"""A tetrahedral mesh that somebody else made: one value, whatever the format that it came in."""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from palpate.errors import ConfigurationError, InputDataError
from palpate.images.input_file import whole_input
from palpate.images.label_image import LPS_TO_RAS
from palpate.images.named_labels import printable
from palpate.mesh.cutting import face_pieces
from palpate.mesh.files.abaqus import read_abaqus
from palpate.mesh.files.elements import CORNERS, MOST_BYTES, Elements, Name, Numbers
from palpate.mesh.files.exodus import read_exodus
from palpate.mesh.files.others import read_by_meshio, read_gmsh, read_med
from palpate.mesh.tet_mesh import FACE_PAIRS
from palpate.mesh.tetrahedralise import boundary_of

READERS = {".msh": read_gmsh, ".inp": read_abaqus, ".med": read_med}
READERS |= dict.fromkeys((".e", ".exo", ".ex2", ".exii", ".g", ".gen"), read_exodus)
HOLLOW = ("vertex", "line", "tri", "quad", "polygon", "VTK_LAGRANGE_C", "VTK_LAGRANGE_TR", "VTK_LAGRANGE_Q")
HEADING = 300  # bytes: the two lines with which .vtk begins, where 3D Slicer names the axes
SLIVER = 1e-9  # least volume over the cube of the longest edge
JOINED = 1e-3  # of the shortest edge at a node: a nearer node is meant to be the same


@dataclass(frozen=True, slots=True)
class MeshFile:
    """Nodes (n, 3) mm, all of tetrahedra; tets (n_tets, 4) of positive volume; piece (n_tets,) that hangs by faces.

    groups: numbers (n,) of tetrahedra, and surfaces: triangles (n_faces, 3) of nodes, -1 for one that is none of the
    mesh, by the name or number of their group; one may belong to several. about: what else the file says of groups;
    digest: SHA-256 of the file.
    """

    nodes: NDArray[np.float64]
    tets: NDArray[np.int64]
    piece: NDArray[np.int64]
    groups: Mapping[Name, NDArray[np.int64]]
    surfaces: Mapping[Name, NDArray[np.int64]]
    about: str
    digest: str


def read_mesh_file(path: Path, *, data: str | None = None) -> MeshFile:
    """Read tetrahedra of 4 or 10 nodes (of the latter the corners), their groups and named surfaces; RAS mm.

    data: the cell data that tell the tissue, by default the first of the usual names. Raises `InputDataError` for a
    file that holds no such mesh, or more, `ConfigurationError` where meshio is missing.
    """
    content, digest = whole_input(path, MOST_BYTES)
    reader = READERS.get(path.suffix.lower())
    if reader is read_gmsh and b"$MeshFormat" not in content[:4096]:
        reader = None  # the ending is Fluent's, too
    try:
        read = reader(content, data) if reader else read_by_meshio(path, data)
        if b"SPACE=LPS" in content[:HEADING]:  # which turns all tetrahedra, and mirrors none
            read = replace(read, points=read.points * LPS_TO_RAS)
        return _sound(read, digest)
    except InputDataError as error:
        raise InputDataError(f"'{path}' is no mesh that is read: {error}") from error
    except ConfigurationError:
        raise
    except Exception as error:  # libraries raise what they like
        raise InputDataError(
            f"'{path}' is no mesh that is read: {type(error).__name__} {printable(str(error))[:200]}; export it as .msh"
            " of version 4.1, or as plain .vtu"
        ) from error


def _sound(read: Elements, digest: str) -> MeshFile:
    """The mesh with its nodes, and all references to them, numbered anew; `InputDataError` for a mesh with faults."""
    count = sum((Counter({kind: len(rows)}) for kind, rows, _ in read.blocks), Counter[str]())
    (tets, groups), (triangles, shown), (points, sets) = (_once(read, corners) for corners in (4, 3, 1))
    if not len(tets):
        raise InputDataError(f"it holds {dict(count)} and no tetrahedra; export a volume mesh of 4 or 10 nodes a cell")
    if others := [f"{n} {kind}" for kind, n in count.items() if kind not in CORNERS and not kind.startswith(HOLLOW)]:
        also = ", ".join(others)
        raise InputDataError(f"beside {len(tets)} tetrahedra it has {also}: split these into tetrahedra")
    corners = np.concatenate([tets.ravel(), triangles.ravel(), points.ravel()])
    if corners.min() < 0 or corners.max() >= len(read.points) or read.points.shape[1] != 3:
        raise InputDataError(f"its elements name nodes that it has not ({len(read.points)} nodes); export it again")
    used, places = np.unique(tets, return_inverse=True)
    new = np.full(len(read.points), -1)
    new[used] = np.arange(len(used))
    tets, piece = _oriented(read.points[used], places.reshape(-1, 4))
    if not any(isinstance(name, int) for name in groups) and len(groups) < 2:
        groups[1] = np.arange(len(tets))
    surfaces = {name: np.unique(np.sort(new[triangles[own]], axis=1), axis=0) for name, own in shown.items()}
    faces = boundary_of(tets) if sets else tets[:0, :3]
    for name, own in sets.items():
        surfaces.setdefault(name, faces[np.isin(faces, new[points[own]]).all(axis=1)])
    return MeshFile(read.points[used], tets, piece, groups, surfaces, read.about, digest)


def _once(read: Elements, corners: int) -> tuple[Numbers, dict[Name, Numbers]]:
    """All elements (n, corners) of so many corners, each once, in their order, and which ones a group has."""
    blocks = [(rows[:, :corners], names) for kind, rows, names in read.blocks if CORNERS.get(kind) == corners]
    every = np.concatenate([np.zeros((0, corners), dtype=np.int64), *(rows for rows, _ in blocks)])
    _, first, same = np.unique(np.sort(every, axis=1), axis=0, return_index=True, return_inverse=True)
    kept, groups = np.sort(first), defaultdict[Name, Numbers](lambda: np.zeros(0, dtype=np.int64))
    parts = np.split(np.searchsorted(kept, first)[same.ravel()], np.cumsum([len(rows) for rows, _ in blocks]))
    for own, (_, names) in zip(parts, blocks, strict=False):
        for name in names if len(own) else ():
            shown = name if isinstance(name, int) else printable(name)[:200]
            groups[shown] = np.union1d(groups[shown], own)
    return every[kept], dict(groups)


def _oriented(nodes: NDArray[np.float64], tets: NDArray[np.int64]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Tetrahedra of positive volume, and the piece of each; `InputDataError` for flat ones, cracks and overlaps."""
    if not np.isfinite(nodes).all():
        raise InputDataError("a node has a coordinate that is no number; export it again")
    corners = nodes[tets]
    volumes = np.linalg.det(corners[:, 1:] - corners[:, :1]) / 6.0
    edges = np.linalg.norm(corners[:, FACE_PAIRS[:, 0]] - corners[:, FACE_PAIRS[:, 1]], axis=2)
    flat = np.abs(volumes) <= SLIVER * edges.max(axis=1) ** 3
    if flat.any():
        where = _place(corners[flat].mean(axis=1))
        raise InputDataError(f"{flat.sum()} of its tetrahedra have no volume, the first {where}; mend it (Mmg, gmsh)")
    shortest = np.full(len(nodes), np.inf)
    np.minimum.at(shortest, tets, edges.min(axis=1)[:, None])
    near = np.asarray(cKDTree(nodes).query(nodes, k=2)[0])[:, 1]
    apart = near < JOINED * shortest
    if apart.any():
        raise InputDataError(
            f"{apart.sum()} of its nodes lie on another one that they are not joined to, as at a crack, the first"
            f" {_place(nodes[apart])}, {near[apart][0]:.2g} mm apart; merge such nodes (gmsh: Coherence Mesh)"
        )
    piece, with_face = face_pieces(tets)
    if over := np.count_nonzero(with_face > 2):
        raise InputDataError(f"{over} faces belong to over two tetrahedra, which overlap: mesh it anew")
    return np.where(volumes[:, None] < 0.0, tets[:, [0, 2, 1, 3]], tets), piece


def _place(points: NDArray[np.float64]) -> str:
    return f"at {np.round(points[0], 2).tolist()} mm"
