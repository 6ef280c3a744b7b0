"""Distance map of one tissue of a segmentation, on the part of the grid around it."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from palpate.errors import InputDataError
from palpate.images.distance import DistanceMap, distance_map, window_around
from palpate.images.label_image import VoxelGrid
from palpate.images.segmentation import Segmentation

REACH_MM = 25.0  # organs that move further are not found again


def tissue_distance_map(
    segmentation: Segmentation, tissue: int, *, smoothing_mm: float, reach_mm: float = REACH_MM, far: bool = True
) -> DistanceMap:
    """Signed distance map of a tissue by its index; it reaches `reach_mm` beyond the tissue's bounding box.

    `smoothing_mm`, `far`: see `distance_map`. Raises `InputDataError` when the image has no voxel of the tissue.
    """
    mask = segmentation.mask(tissue)
    if not mask.any():
        raise InputDataError(f"tissue '{segmentation.tissues[tissue].name}' has no voxel in the image")
    window = window_around(mask, segmentation.grid, reach_mm=reach_mm)
    return distance_map(mask[window], cropped(segmentation.grid, window), smoothing_mm=smoothing_mm, far=far)


def window_of(index: NDArray[np.float64], grid: VoxelGrid, *, margin: int) -> tuple[slice, slice, slice]:
    """Index ranges of the voxels within `margin` of voxel indices (n, 3); one voxel where these lie beyond the grid."""
    last = np.array(grid.shape) - 1
    low = np.clip(np.floor(index.min(axis=0)).astype(np.int64) - margin, 0, last)
    high = np.clip(np.ceil(index.max(axis=0)).astype(np.int64) + margin, 0, last)
    i, j, k = (slice(int(a), int(b) + 1) for a, b in zip(low, high, strict=True))
    return (i, j, k)


def cropped(grid: VoxelGrid, window: tuple[slice, slice, slice]) -> VoxelGrid:
    """The grid of the voxels in `window`, at the same places in the world."""
    affine = np.array(grid.affine)
    affine[:3, 3] = grid.world(np.array([[s.start for s in window]], dtype=float))[0]
    i, j, k = (s.stop - s.start for s in window)
    return VoxelGrid((i, j, k), affine)
