"""Sub-voxel signed distance maps of label images, made by one operator for every image."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage, special

from palpate.images.label_image import VoxelGrid

__all__ = ["DistanceMap", "distance_map", "observation_width", "smoothing_width"]

PROBIT_LIMIT = 2.5  # beyond so many sigma the smoothed indicator has lost the distance to rounding


@dataclass(frozen=True, slots=True)
class DistanceMap:
    """Signed distance (mm, negative inside) to a tissue's surface, interpolated by cubic B-splines.

    `coefficients` (n_x, n_y, n_z) are the spline's; outside the grid the map continues the value on its border.
    `smoothing_mm`: width of the Gaussian that the map was made with; `bias` (mm) is added everywhere.
    """

    coefficients: NDArray[np.float64]
    grid: VoxelGrid
    smoothing_mm: float = 0.0
    bias: float = 0.0

    def at(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Signed distance (n,) mm at points (n, 3) in RAS mm."""
        index = self._inside(points).T
        values = ndimage.map_coordinates(self.coefficients, index, order=3, mode="mirror", prefilter=False)
        return np.asarray(self.bias + values)

    def gradient_at(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Gradient (n, 3), mm per mm, of the interpolated map at points (n, 3) in RAS mm."""
        index = self._inside(points)
        base = np.floor(index).astype(np.int64)
        t = index - base
        s = 1.0 - t
        # cubic B-spline weights (n, 3, 4) of the four nodes around, and their derivatives
        value = np.stack([s**3, 4.0 - 6.0 * t**2 + 3.0 * t**3, 4.0 - 6.0 * s**2 + 3.0 * s**3, t**3], axis=-1) / 6.0
        slope = np.stack([-(s**2), 3.0 * t**2 - 4.0 * t, 4.0 * s - 3.0 * s**2, t**2], axis=-1) / 2.0
        # the coefficients of the 4 x 4 x 4 nodes (n, 4, 4, 4) around, mirrored beyond the border
        _, ny, nz = self.coefficients.shape
        last = np.array(self.coefficients.shape)[:, None] - 1
        nodes = np.abs(base[:, :, None] + np.arange(-1, 3)) % np.maximum(2 * last, 1)
        x, y, z = (last - np.abs(nodes - last)).transpose(1, 0, 2)
        stencil = self.coefficients.ravel().take(
            ((x[:, :, None, None] * ny + y[:, None, :, None]) * nz) + z[:, None, None, :]
        )
        plane, along_z = _contract(stencil, value[:, 2]), _contract(stencil, slope[:, 2])
        line = _contract(plane, value[:, 1])
        by_index = [
            _contract(line, slope[:, 0]),
            _contract(_contract(plane, slope[:, 1]), value[:, 0]),
            _contract(_contract(along_z, value[:, 1]), value[:, 0]),
        ]
        return np.asarray(np.stack(by_index, axis=1) @ np.linalg.inv(self.grid.affine[:3, :3]))

    def node_values(self) -> NDArray[np.float64]:
        """Signed distance (n_x, n_y, n_z) mm at the voxels' centres."""
        values = self.coefficients
        for axis in range(3):
            values = ndimage.convolve1d(values, np.array([1.0, 4.0, 1.0]) / 6.0, axis=axis, mode="mirror")
        return np.asarray(values + self.bias)

    def shifted(self, bias: float) -> DistanceMap:
        """The same map with `bias` (mm) added everywhere."""
        return replace(self, bias=self.bias + bias)

    def _inside(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Voxel indices (n, 3) of points, moved to the grid's border when they lie beyond it."""
        return np.asarray(np.clip(self.grid.index(points), 0.0, np.array(self.grid.shape) - 1.0))


def smoothing_width(*grids: VoxelGrid) -> float:
    """Width sigma (mm) of the Gaussian that turns indicators into surfaces, one for all `grids` of a case.

    0.6 of the largest voxel edge: below that the stairs of the voxels stay in the surface.
    """
    return 0.6 * max(float(grid.spacing.max()) for grid in grids)


def observation_width(*grids: VoxelGrid) -> float:
    """Width sigma (mm) of the Gaussian for the surfaces that are compared, one for all `grids` of a case.

    As `smoothing_width`, but a voxel up to 1 mm: terraces of nearly grid-parallel surfaces vanish, and what the
    smoothing does to curved surfaces is the same in both images.
    """
    edge = max(grid.voxel_volume ** (1.0 / 3.0) for grid in grids)
    return float(max(smoothing_width(*grids), min(1.0, edge)))


def distance_map(mask: NDArray[np.bool_], grid: VoxelGrid, *, smoothing_mm: float, far: bool = True) -> DistanceMap:
    """Signed distance map of the voxels in `mask` (n_x, n_y, n_z).

    Near the surface the probit of the smoothed indicator, d = -sigma Phi^-1(G_sigma * 1_mask), which is exact for a
    plane; far from it the Euclidean distance transform, blended over one sigma. `smoothing_mm` is sigma, mm. Without
    `far` the map ends in planes of 2.5 sigma, for what is asked near the surface: a third of the price.
    """
    sigma = smoothing_mm / grid.spacing
    share = ndimage.gaussian_filter(mask.astype(np.float64), sigma, mode="nearest", truncate=5.0)
    near = -smoothing_mm * special.ndtri(np.clip(share, 1e-12, 1.0 - 1e-12))
    weight = np.clip(np.abs(near) / smoothing_mm - (PROBIT_LIMIT - 1.0), 0.0, 1.0)
    limit = PROBIT_LIMIT * smoothing_mm
    if not far:
        distance = np.clip(near, -limit, limit)
    elif not mask.any() or mask.all():
        size = float(np.linalg.norm(grid.spacing * grid.shape))
        distance = np.full(mask.shape, -size if mask.all() else size)
    else:  # between voxel centres, less half a voxel so that it is zero on the faces between them
        half = 0.5 * float(grid.spacing.mean())
        distance = np.where(
            mask,
            half - ndimage.distance_transform_edt(mask, sampling=grid.spacing),
            ndimage.distance_transform_edt(~mask, sampling=grid.spacing) - half,
        )
    values = (1.0 - weight) * near + weight * distance
    return DistanceMap(ndimage.spline_filter(values, order=3, mode="mirror"), grid, smoothing_mm)


def _contract(block: NDArray[np.float64], weights: NDArray[np.float64]) -> NDArray[np.float64]:
    """Sum of block (n, ..., 4) over its last axis with weights (n, 4)."""
    inner = int(np.prod(block.shape[1:-1]))  # not -1, which no points at all would leave undefined
    flat = block.reshape(len(block), inner, 4)
    return np.asarray(np.matmul(flat, weights[:, :, None])[..., 0].reshape(block.shape[:-1]))
