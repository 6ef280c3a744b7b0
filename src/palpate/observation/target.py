"""What an image pair says of one surface: distance maps before and after, and points on the later surface."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from palpate.images.distance import DistanceMap
from palpate.images.isosurface import isosurface_points
from palpate.mesh.surface import triangle_normals
from palpate.observation.observed_surface import ObservedSurface

__all__ = ["SurfaceTarget", "surface_target"]

# Strang & Fix 1973: three interior points, exact for quadratics
QUADRATURE = np.array([[4.0, 1.0, 1.0], [1.0, 4.0, 1.0], [1.0, 1.0, 4.0]]) / 6.0


@dataclass(frozen=True, slots=True)
class SurfaceTarget:
    """One surface of the model and both images of it.

    triangle (n_q,), barycentric (n_q, 3), area (n_q,) mm^2: quadrature on the observed triangles;
    rest_distance (n_q,) mm: the map `before` there, subtracted from the map `after` (difference to the rest state);
    level (mm): its mean; image_points (n_i, 3) mm with areas (n_i,) mm^2: the later surface, taken at `level`.
    """

    surface: ObservedSurface
    before: DistanceMap
    after: DistanceMap
    triangle: NDArray[np.int64]
    barycentric: NDArray[np.float64]
    area: NDArray[np.float64]
    rest_distance: NDArray[np.float64]
    level: float
    image_points: NDArray[np.float64]
    image_area: NDArray[np.float64]


def surface_target(surface: ObservedSurface, before: DistanceMap, after: DistanceMap) -> SurfaceTarget:
    """Make the target of `surface` from the maps of its tissue in the two images.

    The later surface is taken where `after` equals the mean of `before` over the model's rest surface, so that a bias
    common to both maps changes nothing.
    """
    seen = np.flatnonzero(surface.observed)
    triangle = np.repeat(seen, len(QUADRATURE))
    barycentric = np.tile(QUADRATURE, (len(seen), 1))
    size = np.linalg.norm(triangle_normals(surface.rest, surface.triangles[seen]), axis=1)
    area = np.repeat(size / len(QUADRATURE), len(QUADRATURE))
    # (n_q, 3 corners, 3 axes) -> (n_q, 3)
    places = np.einsum("qk,qka->qa", barycentric, surface.rest[surface.triangles[triangle]])
    rest_distance = before.at(places)
    level = float(np.average(rest_distance, weights=area))
    points = isosurface_points(after, level)
    return SurfaceTarget(
        surface, before, after, triangle, barycentric, area, rest_distance, level, points.places, points.area
    )
