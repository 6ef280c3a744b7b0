"""Lagrange nodes of order 1 or 2 on a mesh: the points where a displacement has its values, and which are free."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from palpate.errors import ConfigurationError
from palpate.mesh.tet_mesh import TetMesh

TET_EDGES = np.array([[0, 1], [1, 2], [0, 2], [0, 3], [1, 3], [2, 3]])
TRIANGLE_EDGES = np.array([[0, 1], [1, 2], [0, 2]])


@dataclass(frozen=True, slots=True)
class LagrangeSpace:
    """Continuous piecewise polynomials of `order` 1 (P1) or 2 (P2) on straight-sided tetrahedra.

    points (n_points, 3) mm: the mesh's nodes, then for P2 the middles of its edges; cells (n_tets, 4 or 10): corners,
    then edges in the order of TET_EDGES; edges (n_edges, 2) node numbers, sorted (empty for P1).
    """

    mesh: TetMesh
    order: int
    points: NDArray[np.float64]
    cells: NDArray[np.int64]
    edges: NDArray[np.int64]

    def facets(self, triangles: NDArray[np.int64]) -> NDArray[np.int64]:
        """Points (n_faces, 3 or 6) of triangles (n_faces, 3): corners, then edges in the order of TRIANGLE_EDGES."""
        if self.order == 1:
            return triangles
        n = len(self.mesh.nodes)
        pairs = np.sort(triangles[:, TRIANGLE_EDGES], axis=2)
        place = np.searchsorted(self.edges[:, 0] * n + self.edges[:, 1], pairs[..., 0] * n + pairs[..., 1])
        return np.asarray(np.concatenate([triangles, n + place], axis=1))

    def interpolation(
        self, triangles: NDArray[np.int64], barycentric: NDArray[np.float64]
    ) -> sparse.csr_matrix[np.float64]:
        """Matrix (n_faces, n_points), dimensionless: values at `barycentric` (n_faces, 3) of triangles (n_faces, 3)."""
        facets = self.facets(triangles)
        weights = shape_functions(self.order, barycentric)
        rows = np.repeat(np.arange(len(facets)), facets.shape[1])
        shape = (len(facets), len(self.points))
        return sparse.csr_matrix((weights.ravel(), (rows, facets.ravel())), shape=shape)


def lagrange_space(mesh: TetMesh, element: str) -> LagrangeSpace:
    """The space of `element` "P1" or "P2" on `mesh`; raises `ConfigurationError` for another name."""
    if element not in ("P1", "P2"):
        raise ConfigurationError(f"element is '{element}'; it must be 'P1' or 'P2'")
    if element == "P1":
        return LagrangeSpace(mesh, 1, mesh.nodes, mesh.tets, np.zeros((0, 2), dtype=np.int64))
    n = len(mesh.nodes)
    pairs = np.sort(mesh.tets[:, TET_EDGES], axis=2).reshape(-1, 2)
    keys, inverse = np.unique(pairs[:, 0] * n + pairs[:, 1], return_inverse=True)
    edges = np.stack([keys // n, keys % n], axis=1)
    points = np.concatenate([mesh.nodes, mesh.nodes[edges].mean(axis=1)])
    cells = np.concatenate([mesh.tets, n + inverse.reshape(-1, 6)], axis=1)
    return LagrangeSpace(mesh, 2, points, cells, edges)


def shape_functions(order: int, barycentric: NDArray[np.float64]) -> NDArray[np.float64]:
    """Shape functions (n, n_points), dimensionless, at `barycentric` places (n, 3) of a triangle or (n, 4) of a tet.

    P1: lambda_a; P2: lambda_a (2 lambda_a - 1) at the corners, 4 lambda_a lambda_b on TRIANGLE_EDGES or TET_EDGES.
    """
    if order == 1:
        return barycentric
    first, second = (TET_EDGES if barycentric.shape[1] == 4 else TRIANGLE_EDGES).T
    corners = barycentric * (2.0 * barycentric - 1.0)
    return np.concatenate([corners, 4.0 * barycentric[:, first] * barycentric[:, second]], axis=1)


@dataclass(frozen=True, slots=True)
class Constraint:
    """Admissible displacements u = free z + modes q + offset of a Lagrange space with n_dof = 3 n_points unknowns.

    The unknown of point p along axis a has the number 3 p + a. free (n_dof, n_free) sparse with orthonormal columns,
    dimensionless; modes (n_dof, n_modes) mm per unit of q; offset (n_dof,) mm. Rows of `modes` and `offset` are zero
    where `free` is not (but for a sliding node, which is given along its normal only).
    """

    free: sparse.csr_matrix[np.float64]
    modes: NDArray[np.float64]
    offset: NDArray[np.float64]

    @property
    def n_modes(self) -> int:
        """Number of unknown modes."""
        return int(self.modes.shape[1])
