"""Where points lie in a mesh: the tetrahedron of each, that of each voxel, and the values of a displacement there."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.spatial import cKDTree

from palpate.images.label_image import VoxelGrid
from palpate.mesh.space import LagrangeSpace, shape_functions
from palpate.mesh.tet_mesh import TetMesh
from palpate.parallel import mapped

CANDIDATES = (8, 48, 240)  # tetrahedra that are tried, those with the nearest centroids first
AT_ONCE = 200_000  # pairs of a point and a tetrahedron
ON_A_FACE = 1e-9  # in barycentric coordinates
ROUNDED = 1e-3  # of a tetrahedron's height: points that are outside by less count as inside, for tables have few digits
COLUMNS_AT_ONCE = 300_000  # columns of voxels that a thread tests together, which limits the memory


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
    """Where points (n, 3) mm lie in the mesh; one that lies outside by rounding alone is in the tetrahedron beside it.

    Its coordinates are then as little below 0: values there are continued, and those of a polynomial stay exact.
    """
    corners = mesh.nodes[mesh.tets]
    inverse = np.linalg.inv(corners[:, 1:] - corners[:, :1])  # rows: edges; x - x0 = b @ edges
    tree = cKDTree(corners.mean(axis=1))
    tet, barycentric = np.full(len(points), -1, dtype=np.int64), np.full((len(points), 4), -np.inf)
    room = ROUNDED * np.ptp(corners, axis=1).max()
    low, high = mesh.nodes.min(axis=0) - room, mesh.nodes.max(axis=0) + room
    left = np.flatnonzero(np.all((points >= low) & (points <= high), axis=1))
    for k in (min(k, len(mesh.tets)) for k in CANDIDATES):
        for part in np.array_split(left, 1 + len(left) * k // AT_ONCE):
            near = np.atleast_2d(tree.query(points[part], k=k)[1].reshape(len(part), k))
            away = points[part][:, None] - corners[near, 0]
            shares = np.einsum("nki,nkij->nkj", away, inverse[near])
            every = np.concatenate([1.0 - shares.sum(axis=2, keepdims=True), shares], axis=2)
            best = np.argmax(every.min(axis=2), axis=1)
            found = every[np.arange(len(part)), best]
            better = found.min(axis=1) > barycentric[part].min(axis=1)
            tet[part[better]] = near[np.arange(len(part)), best][better]
            barycentric[part[better]] = found[better]
        left = left[barycentric[left].min(axis=1) < -ON_A_FACE]
    out = barycentric.min(axis=1) < -ROUNDED
    tet[out], barycentric[out] = -1, 0.0
    return Places(tet, barycentric)


def point_interpolation(space: LagrangeSpace, places: Places) -> sparse.csr_matrix[np.float64]:
    """Matrix (n, n_points), dimensionless, of the values at places inside the mesh of a field with values at points."""
    b, cells = places.barycentric, space.cells[places.tet]
    weights = shape_functions(space.order, b)
    rows = np.repeat(np.arange(len(cells)), cells.shape[1])
    shape = (len(cells), len(space.points))
    return sparse.csr_matrix((weights.ravel(), (rows, cells.ravel())), shape=shape)


def region_image(mesh: TetMesh, grid: VoxelGrid) -> NDArray[np.int16]:
    """Region (n_x, n_y, n_z) of the tetrahedron at each voxel centre of `grid`: index into `mesh.tissues`; -1: none."""
    return np.append(mesh.region, -1).astype(np.int16)[tetrahedron_image(mesh, grid)]


def modulus_image(mesh: TetMesh, grid: VoxelGrid, moduli: NDArray[np.float64]) -> NDArray[np.float64]:
    """Moduli (n_tissues,) at each voxel centre (n_x, n_y, n_z) of `grid`, in their unit; 0 where nothing is meshed.

    Viewers show NaN as anything.
    """
    return np.asarray(np.nan_to_num(np.append(moduli, 0.0))[region_image(mesh, grid)])


def tetrahedron_image(mesh: TetMesh, grid: VoxelGrid) -> NDArray[np.int32]:
    """Number (n_x, n_y, n_z) of the tetrahedron at each voxel centre of `grid`; -1: none.

    Along a column of voxels each barycentric coordinate is linear in z, so that a tetrahedron holds one stretch of it.
    """
    image = np.full(grid.shape, -1, dtype=np.int32)
    corners = grid.index(mesh.nodes)[mesh.tets]
    low = np.maximum(np.ceil(corners.min(axis=1) - ON_A_FACE), 0).astype(np.int64)
    high = np.minimum(np.floor(corners.max(axis=1) + ON_A_FACE), np.array(grid.shape) - 1).astype(np.int64)
    size = np.maximum(high - low + 1, 0)
    count = np.where(size[:, 2] > 0, size[:, 0] * size[:, 1], 0)
    edges = np.linalg.inv(corners[:, 1:] - corners[:, :1])  # rows: edges; x - x0 = b @ edges
    by_index = np.concatenate([-edges.sum(axis=2, keepdims=True), edges], axis=2)  # derivative (n, 3, 4) of each b
    at_origin = np.eye(4)[0] - np.einsum("na,nab->nb", corners[:, 0], by_index)

    def columns_of(tets: NDArray[np.int64]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Voxels (n, 3) whose centres lie in some of the tetrahedra, and in which (n,)."""
        owner = np.repeat(tets, count[tets])
        step = np.arange(len(owner)) - np.repeat(np.cumsum(count[tets]) - count[tets], count[tets])
        x, y = np.divmod(step, size[owner, 1]) + low[owner, :2].T  # from the step's number in the tetrahedron's box
        first, last = low[owner, 2].astype(float), high[owner, 2].astype(float)
        for b in range(4):
            below = at_origin[owner, b] + by_index[owner, 0, b] * x + by_index[owner, 1, b] * y + ON_A_FACE
            slope = by_index[owner, 2, b]
            with np.errstate(divide="ignore", invalid="ignore"):
                end = np.where((slope == 0.0) & (below >= 0.0), np.nan, -below / slope)  # none of a side along z
            np.fmax(first, end, out=first, where=slope >= 0.0)
            np.fmin(last, end, out=last, where=slope <= 0.0)
        first, last = np.ceil(first), np.floor(last)
        met = np.flatnonzero(first <= last)
        length = (last[met] - first[met]).astype(np.int64) + 1
        column = np.repeat(met, length)
        z = np.arange(len(column)) - np.repeat(np.cumsum(length) - length - first[met].astype(np.int64), length)
        return np.stack([x[column], y[column], z], axis=1), owner[column]

    total = np.cumsum(count)
    ends = np.searchsorted(total, np.arange(COLUMNS_AT_ONCE, total[-1], COLUMNS_AT_ONCE))
    for voxel, owner in mapped(columns_of, np.split(np.arange(len(count)), ends)):
        image[tuple(voxel.T)] = owner
    return image
