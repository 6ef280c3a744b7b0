"""How far the surface of a tissue moves between two images, by counting voxels."""

from __future__ import annotations

import numpy as np

from palpate.images.segmentation import Segmentation

STILL_VOXELS = 0.15  # mean motion of a surface, in voxels, that the voxels' own rounding makes


def wall_motion(before: Segmentation, after: Segmentation, tissue: int) -> float:
    """Mean normal motion of a tissue's surface, mm: the volume that it gains and loses, by its area.

    The area is that of the voxels' faces times 2/3, its mean over all directions of a plane (Cauchy).
    """
    lost = _outside(before, after, tissue) * before.grid.voxel_volume
    gained = _outside(after, before, tissue) * after.grid.voxel_volume
    faces = 0.0
    spacing = before.grid.spacing
    mask = before.mask(tissue)
    for axis in range(3):
        faces += np.count_nonzero(np.diff(mask, axis=axis)) * float(np.prod(spacing) / spacing[axis])
    return float((lost + gained) / max(2.0 / 3.0 * faces, 1e-9))


def _outside(one: Segmentation, other: Segmentation, tissue: int) -> int:
    """Number of the tissue's voxels in one image that are not its own in the other, within that one's field of view."""
    count = 0
    for voxels in one.voxels(tissue):
        index = np.rint(other.grid.index(one.grid.world(voxels.astype(float)))).astype(np.int64)
        inside = ((index >= 0) & (index < other.grid.shape)).all(axis=1)
        count += int(np.count_nonzero(other.index[tuple(index[inside].T)] != tissue))
    return count
