"""The truth's own surfaces as targets: what an image without voxels would say."""

from __future__ import annotations

from dataclasses import dataclass

import igl
import numpy as np
from numpy.typing import NDArray

from palpate.mesh.surface import triangle_normals
from palpate.observation.observed_surface import ObservedSurface, observed_surface
from palpate.observation.target import SurfaceTarget, target_from
from palpate.phantoms.scene import Scene

__all__ = ["TriangulatedDistance", "exact_target"]


@dataclass(frozen=True, slots=True)
class TriangulatedDistance:
    """Signed distance to a closed triangulated surface, negative inside: vertices (n, 3) mm, triangles (m, 3)."""

    vertices: NDArray[np.float64]
    triangles: NDArray[np.int64]

    def at(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Signed distance (n,) mm at points (n, 3) in RAS mm."""
        return self._query(points)[0]

    def gradient_at(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Gradient (n, 3) at points (n, 3) in RAS mm: away from the closest point, on the surface its normal."""
        distance, closest, normal = self._query(points)
        apart = np.abs(distance) > 1e-7
        scale = np.where(apart, distance, 1.0)[:, None]
        return np.asarray(np.where(apart[:, None], (points - closest) / scale, normal))

    def _query(
        self, points: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
        distance, _, closest, normal = igl.signed_distance(
            np.ascontiguousarray(points), self.vertices, self.triangles, igl.SIGNED_DISTANCE_TYPE_PSEUDONORMAL
        )
        return np.asarray(distance), np.asarray(closest), np.asarray(normal)


def exact_target(scene: Scene, surface: ObservedSurface) -> SurfaceTarget:
    """Target of a model's `surface` made from the surface of the same tissue in the truth, at rest and deformed."""
    truth = observed_surface(scene.space, surface.tissue)
    deformed = truth.rest + scene.displacement[truth.points]
    before, after = (
        TriangulatedDistance(np.ascontiguousarray(vertices), np.ascontiguousarray(truth.triangles))
        for vertices in (truth.rest, deformed)
    )
    seen = truth.triangles[truth.observed]
    area = np.linalg.norm(triangle_normals(deformed, seen), axis=1)
    return target_from(surface, before, after, level=0.0, image=(deformed[seen].mean(axis=1), area))
