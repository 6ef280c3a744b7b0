"""The truth of a scene as a target without voxels, and the same truth with more or less motion."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import igl
import numpy as np
from numpy.typing import NDArray

from palpate.mesh import LagrangeSpace, triangle_normals
from palpate.observation import ObservedSurface, SurfaceTarget, observed_surface, target_from
from palpate.phantoms import Scene, WallMotion

__all__ = ["ScaledMotion", "TriangulatedDistance", "exact_target", "rescaled", "target_of_truth"]

Warp = Callable[[NDArray[np.float64]], NDArray[np.float64]]


@dataclass(frozen=True, slots=True)
class ScaledMotion:
    """`factor` times another motion."""

    motion: WallMotion
    factor: float

    def at(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Displacement (n, 3) mm at wall points (n, 3) in RAS mm."""
        return self.factor * self.motion.at(points)


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
        return self.values_and_gradients(points)[1]

    def values_and_gradients(self, points: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Both by one query: signed distance (n,) mm and gradient (n, 3) at points (n, 3) in RAS mm."""
        distance, closest, normal = self._query(points)
        apart = np.abs(distance) > 1e-7
        scale = np.where(apart, distance, 1.0)[:, None]
        return distance, np.asarray(np.where(apart[:, None], (points - closest) / scale, normal))

    def _query(
        self, points: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
        distance, _, closest, normal = igl.signed_distance(
            np.ascontiguousarray(points), self.vertices, self.triangles, igl.SIGNED_DISTANCE_TYPE_PSEUDONORMAL
        )
        return np.asarray(distance), np.asarray(closest), np.asarray(normal)


def exact_target(scene: Scene, surface: ObservedSurface) -> SurfaceTarget:
    """Target of a model's `surface` made from the surface of the same tissue in the truth, at rest and deformed."""
    return target_of_truth(scene.space, scene.displacement, surface)


def target_of_truth(
    space: LagrangeSpace,
    displacement: NDArray[np.float64],
    surface: ObservedSurface,
    *,
    warps: tuple[Warp, Warp] | None = None,
) -> SurfaceTarget:
    """The same from a truth's `space` and displacement (n_points, 3) mm.

    warps: how boundary noise moves the surface at rest and the deformed one, (n, 3) mm -> (n, 3) mm.
    """
    truth = observed_surface(space, surface.tissue)
    rest, deformed = truth.rest, truth.rest + displacement[truth.points]
    if warps is not None:
        rest, deformed = warps[0](rest), warps[1](deformed)
    before, after = (
        TriangulatedDistance(np.ascontiguousarray(vertices), np.ascontiguousarray(truth.triangles))
        for vertices in (rest, deformed)
    )
    seen = truth.triangles[truth.observed]
    area = np.linalg.norm(triangle_normals(deformed, seen), axis=1)
    return target_from(surface, before, after, level=0.0, image=(deformed[seen].mean(axis=1), area))


def rescaled(scene: Scene, factor: float) -> Scene:
    """The scene of the linear law with `factor` times the motion everywhere, which is again in equilibrium.

    The images stay those of the full motion until the scene is `reimaged`.
    """
    motions = {name: ScaledMotion(motion, factor) for name, motion in scene.motions.items()}
    return replace(scene, displacement=factor * scene.displacement, motions=motions)
