"""The surface of one tissue in a mesh, with what lies on its other side."""

from __future__ import annotations

from dataclasses import dataclass

import igl
import numpy as np
from numpy.typing import NDArray

from palpate.images.tissue import Role
from palpate.mesh.tet_mesh import FACES, OUTER, TetMesh


@dataclass(frozen=True, slots=True)
class Surface:
    """Closed surface of a tissue (open where a hollow tissue leaves the domain).

    triangles (n_faces, 3) node numbers of the mesh, normals pointing out of the tissue;
    other (n_faces,) index of the tissue on the other side, or OUTER.
    """

    triangles: NDArray[np.int64]
    other: NDArray[np.int64]

    @property
    def nodes(self) -> NDArray[np.int64]:
        """Sorted numbers (n_surface_nodes,) of the mesh nodes on the surface."""
        return np.asarray(np.unique(self.triangles))

    def where(self, keep: NDArray[np.bool_]) -> Surface:
        """The part of the surface whose faces are marked in `keep` (n_faces,)."""
        return Surface(self.triangles[keep], self.other[keep])


def tissue_surface(mesh: TetMesh, tissue: int) -> Surface:
    """Surface of a tissue, meshed or hollow, by its index in `mesh.tissues`."""
    if not mesh.tissues[tissue].meshed:
        keep = mesh.beyond == tissue
        flipped = mesh.boundary[keep][:, ::-1]
        every = _keys(mesh.tets[:, FACES].reshape(-1, 3), mesh)
        return Surface(flipped, _look_up(_keys(flipped, mesh), every, np.repeat(mesh.region, 4)))
    inside = mesh.tets[mesh.region == tissue][:, FACES].reshape(-1, 3)
    rest = mesh.tets[mesh.region != tissue][:, FACES].reshape(-1, 3)
    regions = np.repeat(mesh.region[mesh.region != tissue], 4)
    keys, place, count = np.unique(_keys(inside, mesh), return_index=True, return_counts=True)
    single = place[count == 1]
    triangles = inside[single]
    other = _look_up(keys[count == 1], _keys(rest, mesh), regions)
    on_boundary = _look_up(keys[count == 1], _keys(mesh.boundary, mesh), mesh.beyond)
    return Surface(triangles, np.where(other == MISSING, on_boundary, other))


def cut_faces(mesh: TetMesh) -> NDArray[np.int64]:
    """Triangles (n_faces, 3) where the image's border cuts a `known` tissue; normals point out of the body."""
    known = [number for number, tissue in enumerate(mesh.tissues) if tissue.role is Role.KNOWN]
    surfaces = [tissue_surface(mesh, number) for number in known]
    cuts = [surface.triangles[surface.other == OUTER] for surface in surfaces]
    return np.concatenate([np.zeros((0, 3), dtype=np.int64), *cuts])


def triangle_normals(points: NDArray[np.float64], triangles: NDArray[np.int64]) -> NDArray[np.float64]:
    """Normals (n_faces, 3) of triangles with the length of their area, mm^2; points (n_nodes, 3) mm."""
    corner = points[triangles]
    return np.asarray(0.5 * np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]))


def vertex_normals(points: NDArray[np.float64], triangles: NDArray[np.int64]) -> NDArray[np.float64]:
    """Unit normals (n_nodes, 3) at nodes (n_nodes, 3) mm of triangles (n_faces, 3); 0 at nodes of none.

    n = sum a x b / (|a|^2 |b|^2) over a node's triangles with the edges a, b from it, exact for nodes on a ball (Max
    1999, Journal of Graphics Tools 4(2), 1-6). Weighted by area the normal leans towards the largest triangle, and a
    wall that turns in itself seems to move outwards.
    """
    corners = points[triangles]
    edges = np.roll(corners, -1, axis=1) - corners  # each to the next corner
    inverse = edges / np.maximum(np.einsum("tka,tka->tk", edges, edges), 1e-30)[:, :, None]
    weighed = np.cross(np.roll(inverse, 1, axis=1), inverse)  # b, from a corner to the one before it, is minus an edge
    columns = [np.bincount(triangles.ravel(), weighed[..., a].ravel(), minlength=len(points)) for a in range(3)]
    summed = np.stack(columns, axis=1)
    return np.asarray(summed / np.maximum(np.linalg.norm(summed, axis=1, keepdims=True), 1e-30))


MISSING = -9


def _keys(triangles: NDArray[np.int64], mesh: TetMesh) -> NDArray[np.int64]:
    """One number a triangle, whatever the order of its corners."""
    ordered = np.sort(triangles, axis=1)
    n = len(mesh.nodes)
    return np.asarray((ordered[:, 0] * n + ordered[:, 1]) * n + ordered[:, 2])


def _look_up(keys: NDArray[np.int64], table: NDArray[np.int64], values: NDArray[np.int64]) -> NDArray[np.int64]:
    """Value of each key in the table, MISSING where it is not there."""
    if len(table) == 0:
        return np.full(len(keys), MISSING)
    order = np.argsort(table)
    place = np.clip(np.searchsorted(table, keys, sorter=order), 0, len(table) - 1)
    found = table[order[place]] == keys
    return np.asarray(np.where(found, values[order[place]], MISSING))


def mean_curvature(points: NDArray[np.float64], triangles: NDArray[np.int64]) -> NDArray[np.float64]:
    """Mean curvature H (n_nodes,), 1/mm, at nodes (n_nodes, 3) mm of triangles (n_faces, 3): 1/R on a ball.

    Positive where the surface is convex along its normals; a triangulation's is that of its edges, shared out by area.
    H = n . sum_j (cot a_ij + cot b_ij) (x_i - x_j) / (4 A_i), A_i a third of the adjacent triangles (Meyer, Desbrun,
    Schroeder & Barr 2003, equation 8, with barycentric areas).
    """
    vertices, faces = np.ascontiguousarray(points), np.ascontiguousarray(triangles)
    pull = -np.asarray(igl.cotmatrix(vertices, faces) @ vertices)
    areas = igl.massmatrix(vertices, faces, igl.MASSMATRIX_TYPE_BARYCENTRIC).diagonal()
    along = np.einsum("na,na->n", pull, vertex_normals(vertices, faces))
    return np.asarray(0.5 * along / np.maximum(areas, np.finfo(float).tiny))
