"""What an image pair says of one surface: distance maps before and after, and points on the later surface."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from palpate.images.distance import DistanceMap, IsosurfacePoints, isosurface_points, terrace_noise
from palpate.mesh.anatomy import LevelSet, values_and_gradients
from palpate.mesh.surface import triangle_normals
from palpate.observation.observed_surface import FieldOfView, ObservedSurface

# Strang & Fix 1973: three interior points, exact for quadratics; one point where triangles are as small as voxels
THREE_POINTS = np.array([[4.0, 1.0, 1.0], [1.0, 4.0, 1.0], [1.0, 1.0, 4.0]]) / 6.0
ONE_POINT = np.full((1, 3), 1.0 / 3.0)
AREA_OF_A_POINT = 1.6  # mm^2 for each point: residuals within about a voxel carry the same information


@dataclass(frozen=True, slots=True)
class SurfaceTarget:
    """One surface of the model and both images of it.

    triangle (n_q,), barycentric (n_q, 3), area (n_q,) mm^2: quadrature on the observed triangles;
    rest_distance (n_q,) mm: the map `before` there, subtracted from the map `after` (difference to the rest state);
    level (mm): its mean; image_points (n_i, 3) mm with areas (n_i,) mm^2: the later surface, taken at `level`;
    terraces (n_q,) mm^4: coherent rounding noise of the voxels (see `terrace_noise`); `voxels`: the two maps where they
    are made of voxels; view: what the later image shows, None where that is everything.
    """

    surface: ObservedSurface
    before: LevelSet
    after: LevelSet
    triangle: NDArray[np.int64]
    barycentric: NDArray[np.float64]
    area: NDArray[np.float64]
    rest_distance: NDArray[np.float64]
    level: float
    image_points: NDArray[np.float64]
    image_area: NDArray[np.float64]
    terraces: NDArray[np.float64]
    voxels: tuple[DistanceMap, DistanceMap] | None = None
    view: FieldOfView | None = None

    def shown(self, displacement: NDArray[np.float64]) -> NDArray[np.bool_]:
        """Which quadrature points (n_q,) the later image shows once the vertices (n_vertices, 3) mm have moved so."""
        if self.view is None:
            return np.ones(len(self.triangle), dtype=bool)
        corners = (self.surface.rest + displacement)[self.surface.triangles[self.triangle]]
        return self.view.shows(places_within(corners, self.barycentric))

    def terraces_along(self, normals: NDArray[np.float64]) -> NDArray[np.float64]:
        """Coherent rounding noise (n,) mm^4 of the voxels at places with unit normals (n, 3) of a smooth surface.

        The image's own normals would not do: they are noisy with the same rounding, and weights that go with the
        errors of what they weigh bias it.
        """
        return np.zeros(len(normals)) if self.voxels is None else terrace_noise(*self.voxels, normals)


def surface_target(
    surface: ObservedSurface, before: DistanceMap, after: DistanceMap, view: FieldOfView | None = None
) -> SurfaceTarget:
    """Make the target of `surface` from the maps of its tissue in the two images; view: what the later one shows.

    The later surface is taken where `after` equals the mean of `before` over the model's rest surface, so that a bias
    common to both maps changes nothing.
    """
    rest = target_from(surface, before, after, level=0.0, image=(np.zeros((0, 3)), np.zeros(0)))
    normals = triangle_normals(surface.rest, surface.triangles)[rest.triangle]
    normals = normals / np.linalg.norm(normals, axis=1, keepdims=True)
    level = float(np.average(rest.rest_distance, weights=rest.area))
    points = isosurface_points(after, level)
    if view is not None:
        away = view.shows(points.places)
        points = IsosurfacePoints(points.places[away], points.normals[away], points.area[away])
    stride = max(int(AREA_OF_A_POINT * len(points.area) / max(float(points.area.sum()), 1e-9)), 1)
    return replace(
        rest,
        level=level,
        image_points=points.places[::stride],
        image_area=points.area[::stride],
        terraces=terrace_noise(before, after, normals),
        voxels=(before, after),
        view=view,
    )


def places_within(corners: NDArray[np.float64], barycentric: NDArray[np.float64]) -> NDArray[np.float64]:
    """Places (n, 3) mm at barycentric coordinates (n, 3) of triangles with corners (n, 3, 3) mm.

    One way to them: what has not moved then has a residual of zero to the last digit, whatever the processor.
    """
    return np.asarray((barycentric[:, None] @ corners)[:, 0])


def target_from(
    surface: ObservedSurface,
    before: LevelSet,
    after: LevelSet,
    *,
    level: float,
    image: tuple[NDArray[np.float64], NDArray[np.float64]],
) -> SurfaceTarget:
    """Make a target from any two distances and from points (n_i, 3) mm with areas (n_i,) mm^2 of the later surface.

    level (mm): where `after` is on those points.
    """
    seen = np.flatnonzero(surface.observed)
    size = np.linalg.norm(triangle_normals(surface.rest, surface.triangles[seen]), axis=1)
    rule = ONE_POINT if size.mean() < 2.0 * AREA_OF_A_POINT else THREE_POINTS
    triangle = np.repeat(seen, len(rule))
    barycentric = np.tile(rule, (len(seen), 1))
    area = np.repeat(size / len(rule), len(rule))
    places = places_within(surface.rest[surface.triangles[triangle]], barycentric)
    rest, quiet = values_and_gradients(before, places)[0], np.zeros(len(area))
    return SurfaceTarget(surface, before, after, triangle, barycentric, area, rest, level, *image, quiet)
