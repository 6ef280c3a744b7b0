"""Where points lie in a mesh: the tetrahedron of each, and the values of a displacement there."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.spatial import cKDTree

from palpate.mesh.space import TET_EDGES, LagrangeSpace
from palpate.mesh.tet_mesh import TetMesh

CANDIDATES = (8, 48, 240)  # tetrahedra that are tried, the ones with the nearest centroids first
AT_ONCE = 200_000  # pairs of a point and a tetrahedron
ON_A_FACE = 1e-9  # in barycentric coordinates


@dataclass(frozen=True, slots=True)
class Places:
    """Tetrahedron (n,) of each point, -1 outside of all, and its barycentric coordinates (n, 4) there."""

    tet: NDArray[np.int64]
    barycentric: NDArray[np.float64]

    @property
    def inside(self) -> NDArray[np.bool_]:
        """Which points (n,) lie in the mesh."""
        return np.asarray(self.tet >= 0)

    def of(self, chosen: NDArray[np.bool_]) -> Places:
        """Those of some of the points, a mask (n,)."""
        return Places(self.tet[chosen], self.barycentric[chosen])


def located(mesh: TetMesh, points: NDArray[np.float64]) -> Places:
    """Where points (n, 3) mm lie in the mesh."""
    corners = mesh.nodes[mesh.tets]
    inverse = np.linalg.inv(corners[:, 1:] - corners[:, :1])  # rows: edges; x - x0 = b @ edges
    tree = cKDTree(corners.mean(axis=1))
    tet, barycentric = np.full(len(points), -1, dtype=np.int64), np.zeros((len(points), 4))
    low, high = mesh.nodes.min(axis=0), mesh.nodes.max(axis=0)
    left = np.flatnonzero(np.all((points >= low) & (points <= high), axis=1))
    for k in (min(k, len(mesh.tets)) for k in CANDIDATES):
        for part in np.array_split(left, 1 + len(left) * k // AT_ONCE):
            near = np.atleast_2d(tree.query(points[part], k=k)[1].reshape(len(part), k))
            away = points[part][:, None] - corners[near, 0]
            shares = np.einsum("nki,nkij->nkj", away, inverse[near])
            every = np.concatenate([1.0 - shares.sum(axis=2, keepdims=True), shares], axis=2)
            best = np.argmax(every.min(axis=2), axis=1)
            found = every[np.arange(len(part)), best]
            good = found.min(axis=1) >= -ON_A_FACE
            tet[part[good]] = near[np.arange(len(part)), best][good]
            barycentric[part[good]] = found[good]
        left = left[tet[left] < 0]
    return Places(tet, barycentric)


def point_interpolation(space: LagrangeSpace, places: Places) -> sparse.csr_matrix[np.float64]:
    """Matrix (n, n_points), dimensionless, of the values at places inside the mesh of a field with values at points."""
    b, cells = places.barycentric, space.cells[places.tet]
    weights = b
    if space.order == 2:
        edges = 4.0 * b[:, TET_EDGES[:, 0]] * b[:, TET_EDGES[:, 1]]
        weights = np.concatenate([b * (2.0 * b - 1.0), edges], axis=1)
    rows = np.repeat(np.arange(len(cells)), cells.shape[1])
    shape = (len(cells), len(space.points))
    return sparse.csr_matrix((weights.ravel(), (rows, cells.ravel())), shape=shape)
