"""Sub-voxel signed distance maps of label images, made by one operator for every image."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage, special

from palpate.images.label_image import VoxelGrid

__all__ = ["DistanceMap", "distance_map", "smoothing_width"]

PROBIT_LIMIT = 2.5  # beyond so many sigma the smoothed indicator has lost the distance to rounding


@dataclass(frozen=True, slots=True)
class DistanceMap:
    """Signed distance (mm, negative inside) to a tissue's surface, interpolated by cubic B-splines.

    `coefficients` (nx, ny, nz) are the spline's; outside the grid the map continues the value on its border.
    """

    coefficients: NDArray[np.float64]
    grid: VoxelGrid
    bias: float = 0.0

    def at(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Signed distance (n,) mm at points (n, 3) in RAS mm."""
        index = self._inside(self.grid.index(points))
        return self.bias + _spline(self.coefficients, index, (0, 0, 0))

    def gradient_at(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Gradient (n, 3), mm per mm, of the interpolated map at points (n, 3) in RAS mm."""
        index = self._inside(self.grid.index(points))
        by_index = np.stack([_spline(self.coefficients, index, tuple(np.eye(3, dtype=int)[a])) for a in range(3)], 1)
        return np.asarray(by_index @ np.linalg.inv(self.grid.affine[:3, :3]))

    def shifted(self, bias: float) -> DistanceMap:
        """The same map with `bias` (mm) added everywhere."""
        return replace(self, bias=self.bias + bias)

    def _inside(self, index: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.asarray(np.clip(index, 0.0, np.array(self.grid.shape) - 1.0))


def smoothing_width(*grids: VoxelGrid) -> float:
    """Width sigma (mm) of the Gaussian that turns indicators into surfaces, one for all `grids` of a case.

    0.6 of the largest voxel edge: below that the stairs of the voxels stay in the surface.
    """
    return 0.6 * max(float(grid.spacing.max()) for grid in grids)


def distance_map(mask: NDArray[np.bool_], grid: VoxelGrid, *, smoothing_mm: float) -> DistanceMap:
    """Signed distance map of the voxels in `mask` (nx, ny, nz).

    Near the surface the probit of the smoothed indicator, d = -sigma Phi^-1(G_sigma * 1_mask), which is exact for a
    plane; far from it the Euclidean distance transform, blended over one sigma. `smoothing_mm` is sigma, mm.
    """
    sigma = smoothing_mm / grid.spacing
    share = ndimage.gaussian_filter(mask.astype(np.float64), sigma, mode="nearest", truncate=5.0)
    near = -smoothing_mm * special.ndtri(np.clip(share, 1e-12, 1.0 - 1e-12))
    far = _distance_transform(mask, grid)
    weight = np.clip(np.abs(near) / smoothing_mm - (PROBIT_LIMIT - 1.0), 0.0, 1.0)
    values = (1.0 - weight) * near + weight * far
    return DistanceMap(ndimage.spline_filter(values, order=3, mode="mirror"), grid)


def _distance_transform(mask: NDArray[np.bool_], grid: VoxelGrid) -> NDArray[np.float64]:
    """Exact distance between voxel centres, less half a voxel so that it is zero on the faces between them, mm."""
    half = 0.5 * float(grid.spacing.mean())
    if not mask.any() or mask.all():
        size = float(np.linalg.norm(grid.spacing * grid.shape))
        return np.full(mask.shape, -size if mask.all() else size)
    outside = ndimage.distance_transform_edt(~mask, sampling=grid.spacing)
    inside = ndimage.distance_transform_edt(mask, sampling=grid.spacing)
    return np.asarray(np.where(mask, half - inside, outside - half))


def _spline(
    coefficients: NDArray[np.float64], index: NDArray[np.float64], derivative: tuple[int, ...]
) -> NDArray[np.float64]:
    """Value or first derivative of the cubic B-spline at voxel indices (n, 3); mirror beyond the border."""
    base = np.floor(index).astype(np.int64)
    fraction = index - base
    weights = [_slope_weights(fraction[:, a]) if derivative[a] else _value_weights(fraction[:, a]) for a in range(3)]
    places = [_mirror(base[:, a, None] + np.arange(-1, 3), coefficients.shape[a]) for a in range(3)]
    total = np.zeros(len(index))
    for i in range(4):
        for j in range(4):
            weight = weights[0][:, i] * weights[1][:, j]
            column = coefficients[places[0][:, i, None], places[1][:, j, None], places[2]]
            total += weight * np.einsum("nk,nk->n", weights[2], column)
    return total


def _value_weights(t: NDArray[np.float64]) -> NDArray[np.float64]:
    """Cubic B-spline weights (n, 4) of the four nodes around a fraction t in [0, 1)."""
    s = 1.0 - t
    return np.stack([s**3, 4.0 - 6.0 * t**2 + 3.0 * t**3, 4.0 - 6.0 * s**2 + 3.0 * s**3, t**3], axis=1) / 6.0


def _slope_weights(t: NDArray[np.float64]) -> NDArray[np.float64]:
    """Derivatives of the cubic B-spline weights, per voxel."""
    s = 1.0 - t
    return np.stack([-(s**2), 3.0 * t**2 - 4.0 * t, 4.0 * s - 3.0 * s**2, t**2], axis=1) / 2.0


def _mirror(place: NDArray[np.int64], size: int) -> NDArray[np.int64]:
    period = max(2 * (size - 1), 1)
    folded = np.abs(place) % period
    return np.asarray(np.where(folded >= size, period - folded, folded))
