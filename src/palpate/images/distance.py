"""Sub-voxel signed distance maps of label images, by one operator for every image, and points of level surfaces."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage, special

from palpate.errors import InputDataError
from palpate.images.label_image import VoxelGrid
from palpate.images.segmentation import Segmentation

PROBIT_LIMIT = 2.5  # sigma, beyond which rounding hides the distance in the smoothed indicator
TRUNCATED = 5.0  # sigma, at which the Gaussian is cut off
COHERENCE = 1.7  # variance times correlation area of rounding on a patch along a grid plane, in voxel edges^4
BORDER = 1.0  # voxels: nearer to the image's border the map is extrapolated, not measured
REACH_MM = 25.0  # largest motion of an organ that is still found


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
        return self.values_and_gradients(points)[1]

    def values_and_gradients(self, points: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Signed distance (n,) mm and gradient (n, 3), mm per mm, at points (n, 3) in RAS mm, by one look-up.

        The points come last in every array: sums over the 64 nodes around them run along the points.
        """
        index = np.ascontiguousarray(self._inside(points).T)
        base = np.floor(index)
        t = index - base
        s, tt = 1.0 - t, t * t
        ss = s * s
        # cubic B-spline weights (3, 4, n) of the four nodes around along each axis, and their derivatives
        value = np.stack([ss * s, 4.0 - 6.0 * tt + 3.0 * tt * t, 4.0 - 6.0 * ss + 3.0 * ss * s, tt * t], axis=1) / 6.0
        slope = np.stack([-ss, 3.0 * tt - 4.0 * t, 4.0 * s - 3.0 * ss, tt], axis=1) / 2.0
        # the coefficients (4, 4, 4, n) of the nodes around, mirrored beyond the border
        _, ny, nz = self.coefficients.shape
        last = np.array(self.coefficients.shape)[:, None, None] - 1
        nodes = np.abs(base.astype(np.int64)[:, None] + np.arange(-1, 3)[:, None]) % np.maximum(2 * last, 1)
        x, y, z = last - np.abs(nodes - last)
        stencil = self.coefficients.ravel().take((((x * ny)[:, None] + y) * nz)[:, :, None] + z)
        plane, along_z = (np.einsum("xyzn,zn->xyn", stencil, weights[2]) for weights in (value, slope))
        line = np.einsum("xyn,yn->xn", plane, value[1])
        by_index = [
            np.einsum("xn,xn->n", line, slope[0]),
            np.einsum("xn,xn->n", np.einsum("xyn,yn->xn", plane, slope[1]), value[0]),
            np.einsum("xn,xn->n", np.einsum("xyn,yn->xn", along_z, value[1]), value[0]),
        ]
        gradient = np.stack(by_index, axis=1) @ np.linalg.inv(self.grid.affine[:3, :3])
        return np.asarray(self.bias + np.einsum("xn,xn->n", line, value[0])), np.asarray(gradient)

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
    `far` the map ends in planes of 2.5 sigma, for what is asked near the surface: a third of the cost.
    """
    limit, size = PROBIT_LIMIT * smoothing_mm, float(np.linalg.norm(grid.spacing * grid.shape))
    values = np.full(mask.shape, size if far else limit)
    if mask.any():  # the smoothed indicator is zero except around the mask
        box = window_around(mask, grid, reach_mm=TRUNCATED * smoothing_mm + float(grid.spacing.max()))
        within = mask[box]
        if far and mask.all():
            values = -values
        elif far:  # between voxel centres, less half a voxel so that it is zero on the faces between them
            half = 0.5 * float(grid.spacing.mean())
            values = ndimage.distance_transform_edt(~mask, sampling=grid.spacing) - half
            depth = ndimage.distance_transform_edt(within, sampling=grid.spacing)
            values[box] = np.where(within, half - depth, values[box])
        indicator, sigma = within.astype(np.float64), smoothing_mm / grid.spacing
        share = ndimage.gaussian_filter(indicator, sigma, mode="nearest", truncate=TRUNCATED)
        if not far:
            values[box] = np.where(share > 0.5, -limit, limit)
        near = np.abs(share - 0.5) < special.ndtr(PROBIT_LIMIT) - 0.5
        depth = -smoothing_mm * special.ndtri(share[near])
        weight = np.clip(np.abs(depth) / smoothing_mm - (PROBIT_LIMIT - 1.0), 0.0, 1.0) if far else 0.0
        values[box][near] = (1.0 - weight) * depth + weight * values[box][near]
    return DistanceMap(ndimage.spline_filter(values, order=3, mode="mirror"), grid, smoothing_mm)


def window_around(mask: NDArray[np.bool_], grid: VoxelGrid, *, reach_mm: float = 0.0) -> tuple[slice, slice, slice]:
    """Index ranges of the voxels within `reach_mm` of the box around `mask` (n_x, n_y, n_z), which is not empty."""
    window = [slice(None)] * 3
    for axis, reach in enumerate(np.ceil(reach_mm / grid.spacing).astype(int)):
        others = tuple(a for a in range(3) if a != axis)
        # beyond the axes before, the array is empty
        there = np.flatnonzero(mask[tuple(window)].any(axis=others))
        window[axis] = slice(max(int(there[0]) - reach, 0), min(int(there[-1]) + 1 + reach, mask.shape[axis]))
    return (window[0], window[1], window[2])


def terrace_power(distance: DistanceMap, normals: NDArray[np.float64]) -> NDArray[np.float64]:
    """Share (n,), 0 to 1 for cubic voxels, of the rounding to whole voxels that is left in the map, as a power.

    A surface of unit normal (n, 3) tilted by t against the grid's axis a is voxelised in terraces of height h_a and
    length h_a / tan t; the Gaussian of width sigma leaves exp(-4 pi^2 sigma^2 tan^2 t / h_a^2) of their power, here
    times (h_a / h)^2, h the geometric mean of the voxel's edges. The largest of the three axes counts.
    """
    spacing = distance.grid.spacing
    axes = distance.grid.affine[:3, :3] / spacing
    cosine = np.minimum(np.abs(normals @ axes), 1.0)
    tangent2 = 1.0 / np.maximum(cosine, 1e-3) ** 2 - 1.0
    left = np.exp(-4.0 * np.pi**2 * distance.smoothing_mm**2 * tangent2 / spacing**2)
    mean = float(np.prod(spacing)) ** (1.0 / 3.0)
    return np.asarray((left * (spacing / mean) ** 2).max(axis=1))


def terrace_noise(before: DistanceMap, after: DistanceMap, normals: NDArray[np.float64]) -> NDArray[np.float64]:
    """Coherent rounding noise (n,) mm^4 of residuals at surface places with unit normals (n, 3).

    Where a surface lies along a grid plane its voxels are all wrong by the same fraction, over the whole patch, which
    no averaging over neighbours cures: variance (mm^2) times correlation area (mm^2), 1.7 h^4 (p_before + p_after) / 2.
    """
    edge = 0.5 * (before.grid.voxel_volume ** (1.0 / 3.0) + after.grid.voxel_volume ** (1.0 / 3.0))
    power = 0.5 * (terrace_power(before, normals) + terrace_power(after, normals))
    return np.asarray(COHERENCE * edge**4 * power)


@dataclass(frozen=True, slots=True)
class IsosurfacePoints:
    """places (n, 3) RAS mm; normals (n, 3) pointing out of the tissue; area (n,) mm^2 that each stands for."""

    places: NDArray[np.float64]
    normals: NDArray[np.float64]
    area: NDArray[np.float64]


def isosurface_points(distance: DistanceMap, level: float = 0.0) -> IsosurfacePoints:
    """Where the edges of the voxel grid cross the surface {distance = level} (mm).

    A surface element of normal n is crossed by |n_a| / (h_b h_c) edges of axis a a unit of area, so the weight
    h_b h_c |n_a| makes the sum over all three axes exact: sum_a n_a^2 = 1.
    """
    values = distance.node_values() - level
    found = []  # voxel indices (n, 3) where grid edges along each axis cross zero, by linear interpolation
    for along in range(3):
        moved = np.moveaxis(values, along, 0)
        lower, upper = moved[:-1], moved[1:]
        place = np.argwhere((lower < 0.0) != (upper < 0.0))
        start, end = lower[tuple(place.T)], upper[tuple(place.T)]
        crossings = place.astype(np.float64)
        crossings[:, 0] += start / (start - end)
        found.append(crossings[:, np.argsort([along, *[a for a in range(3) if a != along]])])
    axis = np.concatenate([np.full(len(crossings), a) for a, crossings in enumerate(found)])
    index = np.concatenate(found)
    kept = np.all((index >= BORDER) & (index <= np.array(values.shape) - 1.0 - BORDER), axis=1)
    places = distance.grid.world(index[kept])
    directions = (distance.grid.affine[:3, :3] / distance.grid.spacing).T[axis[kept]]
    limit = 0.5 * distance.grid.spacing[axis[kept]]
    for _ in range(2):  # two Newton steps along the grid's edges, each at most half a voxel
        slope = np.einsum("na,na->n", distance.gradient_at(places), directions)
        slope = np.where(np.abs(slope) < 0.05, np.inf, slope)
        step = np.clip((level - distance.at(places)) / slope, -limit, limit)
        places = places + step[:, None] * directions
    gradient = distance.gradient_at(places)
    normals = gradient / np.maximum(np.linalg.norm(gradient, axis=1, keepdims=True), 1e-12)
    face = distance.grid.voxel_volume / distance.grid.spacing[axis[kept]]
    return IsosurfacePoints(places, normals, face * np.abs(np.einsum("na,na->n", normals, directions)))


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


@dataclass(frozen=True, slots=True)
class NearMaps:
    """The distance maps near a segmentation's surfaces, each made once; they end some way from them."""

    image: Segmentation
    _made: dict[tuple[int, float, float], DistanceMap] = field(default_factory=dict, repr=False)

    def of(self, tissue: int, *, smoothing_mm: float, reach_mm: float) -> DistanceMap:
        """That of a tissue by its index; raises as `tissue_distance_map`."""
        key = tissue, smoothing_mm, reach_mm
        if key not in self._made:
            self._made[key] = tissue_distance_map(
                self.image, tissue, smoothing_mm=smoothing_mm, reach_mm=reach_mm, far=False
            )
        return self._made[key]
