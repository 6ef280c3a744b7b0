"""Which tetrahedron a voxel's centre lies in."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from palpate.images.label_image import VoxelGrid
from palpate.mesh.tet_mesh import TetMesh
from palpate.parallel import mapped

CANDIDATES = 1_000_000  # voxel centres tested at once by a thread, which bounds the memory
TOLERANCE = 1e-9  # in barycentric coordinates: a centre on a face belongs to both


def region_image(mesh: TetMesh, grid: VoxelGrid) -> NDArray[np.int16]:
    """Region (n_x, n_y, n_z) of the tetrahedron at each voxel centre of `grid`: index into `mesh.tissues`; -1: none."""
    return np.append(mesh.region, -1).astype(np.int16)[tetrahedron_image(mesh, grid)]


def tetrahedron_image(mesh: TetMesh, grid: VoxelGrid) -> NDArray[np.int32]:
    """Number (n_x, n_y, n_z) of the tetrahedron at each voxel centre of `grid`; -1: none."""
    image = np.full(grid.shape, -1, dtype=np.int32)
    corners = grid.index(mesh.nodes)[mesh.tets]
    low = np.maximum(np.ceil(corners.min(axis=1) - TOLERANCE), 0).astype(np.int64)
    high = np.minimum(np.floor(corners.max(axis=1) + TOLERANCE), np.array(grid.shape) - 1).astype(np.int64)
    size = np.maximum(high - low + 1, 0)
    count = size.prod(axis=1)
    to_barycentric = np.linalg.inv(corners[:, 1:] - corners[:, :1])  # rows: edges; x - x0 = b @ edges

    def centres_of(tets: NDArray[np.int64]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Voxels (n, 3) whose centres lie in some of the tetrahedra, and in which (n,)."""
        owner = np.repeat(tets, count[tets])
        step = np.arange(len(owner)) - np.repeat(np.cumsum(count[tets]) - count[tets], count[tets])
        rest, z = np.divmod(step, size[owner, 2])  # from the step's number in the box of the tetrahedron
        x, y = np.divmod(rest, size[owner, 1])
        voxel = low[owner] + np.stack([x, y, z], axis=1)
        b = np.einsum("na,nab->nb", voxel - corners[owner, 0], to_barycentric[owner])
        inside = (b >= -TOLERANCE).all(axis=1) & (b.sum(axis=1) <= 1.0 + TOLERANCE)
        return voxel[inside], owner[inside]

    ends = np.cumsum(count)
    parts = np.split(np.arange(len(count)), np.searchsorted(ends, np.arange(CANDIDATES, ends[-1], CANDIDATES)))
    for voxel, owner in mapped(centres_of, parts):
        image[tuple(voxel.T)] = owner
    return image
