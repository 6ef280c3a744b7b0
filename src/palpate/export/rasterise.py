"""Which tetrahedron a voxel's centre lies in."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from palpate.images.label_image import VoxelGrid
from palpate.mesh.tet_mesh import TetMesh

__all__ = ["region_image"]

CANDIDATES = 4_000_000  # voxel centres tested at once, which bounds the memory
TOLERANCE = 1e-9  # in barycentric coordinates: a centre on a face belongs to both


def region_image(mesh: TetMesh, grid: VoxelGrid) -> NDArray[np.int16]:
    """Region (n_x, n_y, n_z) of the tetrahedron at each voxel centre of `grid`: index into `mesh.tissues`; -1: none."""
    image = np.full(grid.shape, -1, dtype=np.int16)
    corners = grid.index(mesh.nodes)[mesh.tets]
    low = np.maximum(np.ceil(corners.min(axis=1) - TOLERANCE), 0).astype(np.int64)
    high = np.minimum(np.floor(corners.max(axis=1) + TOLERANCE), np.array(grid.shape) - 1).astype(np.int64)
    size = np.maximum(high - low + 1, 0)
    count = size.prod(axis=1)
    ends = np.cumsum(count)
    for tets in np.split(np.arange(len(count)), np.searchsorted(ends, np.arange(CANDIDATES, ends[-1], CANDIDATES))):
        owner = np.repeat(tets, count[tets])
        step = np.arange(len(owner)) - np.repeat(np.cumsum(count[tets]) - count[tets], count[tets])
        voxel = low[owner] + _unravel(step, size[owner])
        inside = _inside(corners, owner, voxel)
        image[tuple(voxel[inside].T)] = mesh.region[owner[inside]]
    return image


def _unravel(step: NDArray[np.int64], size: NDArray[np.int64]) -> NDArray[np.int64]:
    """Place (n, 3) of the number `step` (n,) in a box of `size` (n, 3)."""
    rest, z = np.divmod(step, size[:, 2])
    x, y = np.divmod(rest, size[:, 1])
    return np.stack([x, y, z], axis=1)


def _inside(corners: NDArray[np.float64], owner: NDArray[np.int64], voxel: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Whether each voxel centre (n, 3) lies in the tetrahedron of that number."""
    to_barycentric = np.linalg.inv(corners[:, 1:] - corners[:, :1])  # rows: edges; x - x0 = b @ edges
    b = np.einsum("na,nab->nb", voxel - corners[owner, 0], to_barycentric[owner])
    return np.asarray((b >= -TOLERANCE).all(axis=1) & (b.sum(axis=1) <= 1.0 + TOLERANCE))
