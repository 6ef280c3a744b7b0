"""Filling of a hollow organ of any shape, for simulations on real anatomy."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from palpate.errors import GeometryError
from palpate.images.distance import DistanceMap, distance_map
from palpate.images.segmentation import Segmentation
from palpate.images.tissue_distance import cropped, window_around

__all__ = ["WallFilling", "wall_filling"]

DIRECTION_MM = 6.0  # smoothing of the wall before its normals are taken, so that folds do not cross
END = 0.1  # share of the filling left at the organ's two ends


@dataclass(frozen=True, slots=True)
class WallFilling:
    """The wall moves along the smoothed wall's normal, by `filling_mm` half way along the organ and less to its ends.

    u(x) = filling_mm (END + (1 - END) cos^2(pi t / 2)) grad(phi) / |grad(phi)|, with t (-1 to 1) the place along the
    organ's longest `axis` (3,) through `centre` (3,) mm, `half_length` (mm) to either side.
    """

    wall: DistanceMap
    filling_mm: float
    centre: NDArray[np.float64]
    axis: NDArray[np.float64]
    half_length: float

    def at(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Displacement (n, 3) mm at wall points (n, 3) in RAS mm."""
        normal = self.wall.gradient_at(points)
        normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-9)
        place = np.clip((points - self.centre) @ self.axis / self.half_length, -1.0, 1.0)
        along = END + (1.0 - END) * np.cos(0.5 * np.pi * place) ** 2
        return np.asarray(self.filling_mm * along[:, None] * normal)


def wall_filling(segmentation: Segmentation, tissue: int, *, filling_mm: float) -> WallFilling:
    """The filling of a tissue of the segmentation, by its index; raises `GeometryError` for one of a few voxels."""
    mask = segmentation.mask(tissue)
    voxels = segmentation.grid.world(np.argwhere(mask).astype(float))
    if len(voxels) < 10:
        raise GeometryError(
            f"'{segmentation.tissues[tissue].name}' has {len(voxels)} voxels: too few to fill; check its label"
        )
    window = window_around(mask, segmentation.grid, reach_mm=3.0 * DIRECTION_MM)
    sigma = DIRECTION_MM / segmentation.grid.spacing
    sharp = distance_map(mask[window], cropped(segmentation.grid, window), smoothing_mm=1.0 + DIRECTION_MM / 10.0)
    smooth = DistanceMap(ndimage.gaussian_filter(sharp.coefficients, sigma, mode="nearest"), sharp.grid)
    centre = voxels.mean(axis=0)
    axis = np.linalg.eigh((voxels - centre).T @ (voxels - centre))[1][:, -1]
    half_length = float(np.abs((voxels - centre) @ axis).max())
    return WallFilling(smooth, filling_mm, centre, axis, half_length)
