"""Points on the level surface of a distance map, with the area that each stands for."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from palpate.images.distance import DistanceMap

BORDER = 1.0  # voxels: nearer to the image's border the map is a continuation, not a measurement


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
