"""A tetrahedral mesh that somebody else made: one value, whatever the format that it came in."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from palpate.errors import ConfigurationError, InputDataError
from palpate.images.input_file import open_input
from palpate.images.label_image import LPS_TO_RAS
from palpate.images.named_labels import printable
from palpate.mesh.cutting import face_pieces
from palpate.mesh.files.abaqus import read_abaqus
from palpate.mesh.files.elements import MOST_BYTES, Elements, Name, Sets
from palpate.mesh.files.exodus import read_exodus
from palpate.mesh.files.others import read_by_meshio, read_gmsh, read_med
from palpate.mesh.tet_mesh import FACE_PAIRS
from palpate.mesh.tetrahedralise import boundary_of

READERS = {".msh": read_gmsh, ".inp": read_abaqus, ".med": read_med}
READERS |= dict.fromkeys((".e", ".exo", ".ex2", ".exii", ".g", ".gen"), read_exodus)
TETRAHEDRA, TRIANGLES = ("tetra", "tetra10"), ("triangle", "triangle6")
HOLLOW = ("vertex", "line", "tri", "quad", "polygon", "VTK_LAGRANGE_C", "VTK_LAGRANGE_TR", "VTK_LAGRANGE_Q")
HEADING = 300  # bytes: the two lines with which .vtk begins, where 3D Slicer names the axes
SLIVER = 1e-9  # volume over the cube of the longest edge
JOINED = 1e-3  # of the shortest edge at a node: another one so near is meant to be the same


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
    try:
        with open_input(path) as file:
            if file.n_bytes > MOST_BYTES:
                raise InputDataError(f"'{path}' has {file.n_bytes / 2**30:.1f} GB; meshes of up to 4 GB are read")
            content, digest = file.read(), file.sha256()
    except (OSError, ValueError) as error:
        raise InputDataError(f"'{path}' cannot be read: {error}; check the path") from error
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
    """The mesh, its nodes numbered anew, with all that speaks of them; `InputDataError` for what is no sound one."""
    tets, of_tets = read.of(TETRAHEDRA, 4)
    triangles, of_triangles = read.of(TRIANGLES, 3)
    count = Counter[str]()
    for kind, rows in read.blocks:
        count[kind] += len(rows)
    others = ", ".join(
        f"{n} {kind}" for kind, n in count.items() if n and kind not in TETRAHEDRA and not kind.startswith(HOLLOW)
    )
    if others and len(tets):
        raise InputDataError(
            f"beside {len(tets)} tetrahedra it has {others}: split these into tetrahedra of 4 or 10 nodes"
        )
    if not len(tets):
        raise InputDataError(f"it holds {dict(count)} and no tetrahedra; export a volume mesh of 4 or 10 nodes a cell")
    if tets.min() < 0 or tets.max() >= len(read.points) or read.points.shape[1] != 3:
        raise InputDataError(f"its tetrahedra name nodes that it has not ({len(read.points)} nodes); export it again")
    _, first, same = np.unique(np.sort(tets, axis=1), axis=0, return_index=True, return_inverse=True)
    kept = np.sort(first)  # gmsh writes what is in two groups twice
    number = np.full((2, sum(count.values())), -1)
    number[0, of_tets] = np.searchsorted(kept, first)[same.ravel()]
    number[1, of_triangles] = np.arange(len(triangles))
    used, places = np.unique(tets[kept], return_inverse=True)
    nodes, tets = read.points[used], places.reshape(-1, 4)
    new = np.full(len(read.points), -1)
    new[used] = np.arange(len(used))
    tets, piece = _oriented(nodes, tets)
    groups = {name: own for name, own in _members(read.sets, number[0]).items() if len(own)}
    if not any(isinstance(name, int) for name in groups) and len(groups) < 2:
        groups[1] = np.arange(len(tets))
    shown = {name: new[triangles[own]] for name, own in _members(read.sets, number[1]).items() if len(own)}
    surfaces = {name: np.unique(np.sort(rows, axis=1), axis=0) for name, rows in shown.items()}
    faces = boundary_of(tets) if read.point_sets else tets[:0, :3]
    for name, own in _members(read.point_sets, new).items():
        surfaces.setdefault(name, faces[np.isin(faces, own).all(axis=1)])
    return MeshFile(nodes, tets, piece, groups, surfaces, read.about, digest)


def _members(sets: Sets, number: NDArray[np.int64]) -> dict[Name, NDArray[np.int64]]:
    """New numbers of the members of each set, each once, by the old ones' new `number`, -1 for what is left out."""
    shown = {name: name if isinstance(name, int) else printable(name)[:200] for name in sets}
    every = {shown[name]: np.unique(number[np.concatenate(parts)]) for name, parts in sets.items() if parts}
    return {name: own[own >= 0] for name, own in every.items()}


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
        raise InputDataError(
            f"{flat.sum()} of its tetrahedra have no volume, the first {where}; repair it, by Mmg or gmsh"
        )
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
    if with_face.max() > 2:
        raise InputDataError(
            f"{(with_face > 2).sum()} faces belong to over two tetrahedra, which overlap: mesh it anew"
        )
    return np.where(volumes[:, None] < 0.0, tets[:, [0, 2, 1, 3]], tets), piece


def _place(points: NDArray[np.float64]) -> str:
    return f"at {np.round(points[0], 2).tolist()} mm"
