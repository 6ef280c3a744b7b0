"""Twin problems: two balls beside a driver, with targets that are exact or go through voxels."""

from __future__ import annotations

from dataclasses import dataclass, replace

import igl
import numpy as np

from palpate.images.segmentation import Segmentation
from palpate.images.tissue import Role, Tissue
from palpate.images.tissue_distance import tissue_distance_map
from palpate.inversion.gauss_newton import Bounds
from palpate.inversion.invert import InverseProblem, InversionSettings
from palpate.inversion.modulus_map import modulus_map
from palpate.mechanics.boundary import outer_constraint
from palpate.mechanics.linear_model import linear_model
from palpate.mesh.anatomy import Anatomy, Box
from palpate.mesh.space import lagrange_space
from palpate.mesh.surface import triangle_normals
from palpate.mesh.tetrahedralise import tetrahedralise
from palpate.mesh.voxelise import voxelise
from palpate.observation.observed_surface import observed_surface
from palpate.observation.prescribed_motion import prescribed_motion
from palpate.observation.target import QUADRATURE, SurfaceTarget, surface_target
from palpate.phantoms.scene import centred_grid
from palpate.phantoms.shapes import ball

GLAND = Tissue("gland", Role.ESTIMATE, (1,))
SAC = Tissue("sac", Role.ESTIMATE, (2,))
TUBE = Tissue("tube", Role.DRIVER, (3,))
REST = Tissue("rest", Role.KNOWN, youngs_modulus_kpa=10.0)
BALLS = (ball([0.0, -9.0, -4.0], 8.0), ball([0.0, -4.0, 11.0], 7.0), ball([0.0, 9.0, -2.0], 7.0))
HALF = 22.0
TRUTH = np.log([3.0, 2.0])  # of gland and sac, to the rest
WALL = 3.0  # mm by which the wall moves, about


@dataclass(frozen=True)
class FacetedDistance:
    """Exact signed distance to a closed triangulated surface, in place of a `DistanceMap`."""

    vertices: np.ndarray
    triangles: np.ndarray
    bias: float = 0.0

    def at(self, points):
        return self._closest(points)[0] + self.bias

    def gradient_at(self, points):
        distance, face, places = self._closest(points)
        normals = triangle_normals(self.vertices, self.triangles)[face]
        normals /= np.linalg.norm(normals, axis=1, keepdims=True)
        far = np.abs(distance) > 1e-9
        away = (points - places) / np.where(far, distance, 1.0)[:, None]
        return np.where(far[:, None], away, normals)

    def _closest(self, points):
        return igl.signed_distance(
            np.ascontiguousarray(points),
            np.ascontiguousarray(self.vertices),
            np.ascontiguousarray(self.triangles),
            sign_type=igl.SIGNED_DISTANCE_TYPE_PSEUDONORMAL,
        )[:3]


def exact_target(surface, displacement) -> SurfaceTarget:
    """Target whose images are the model's own triangles, at rest and under `displacement` (n_vertices, 3)."""
    seen = np.flatnonzero(surface.observed)
    triangle, barycentric = np.repeat(seen, 3), np.tile(QUADRATURE, (len(seen), 1))
    moved = surface.rest + displacement
    size = np.linalg.norm(triangle_normals(surface.rest, surface.triangles[seen]), axis=1)
    places = np.einsum("qk,qka->qa", barycentric, moved[surface.triangles[triangle]])
    before, after = (FacetedDistance(points, surface.triangles) for points in (surface.rest, moved))
    area = np.repeat(size / 3.0, 3)
    return SurfaceTarget(
        surface, before, after, triangle, barycentric, area, np.zeros(len(area)), 0.0, places, area.copy()
    )


@dataclass(frozen=True)
class Twin:
    """A problem, what it was made of, and the truth: moduli (kPa), mode coefficients and displacement (mm)."""

    problem: InverseProblem
    moduli: np.ndarray
    coefficients: np.ndarray
    displacement: np.ndarray
    space: object


def tissues_of(*, known: bool):
    return (GLAND, SAC, TUBE, REST if known else Tissue("rest", Role.ESTIMATE))


def space_of(edge_length_mm, *, known=True, element="P1"):
    anatomy = Anatomy(tissues_of(known=known), (*BALLS, None), Box(np.full(3, -HALF), np.eye(3), np.full(3, 2 * HALF)))
    return lagrange_space(tetrahedralise(anatomy, edge_length_mm=edge_length_mm), element)


def model_of(space, n_modes):
    motion = prescribed_motion(space, {}, n_modes=n_modes, kernel_mm=12.0, prior_mm=WALL)
    constraint = outer_constraint(
        space, outer="fixed", modes=motion.modes, offset=motion.offset, prescribed=motion.prescribed
    )
    return linear_model(space, constraint)


def exact_twin(space, *, n_modes=12, theta=TRUTH) -> Twin:
    """The same mesh makes the data and reads them."""
    model = model_of(space, n_modes)
    tissues = space.mesh.tissues
    mapping = modulus_map(tissues, model.regions)
    moduli = mapping.moduli(theta)
    coefficients = np.random.default_rng(5).standard_normal(model.n_modes)
    displacement = model.solve(moduli, coefficients).displacement
    surfaces = [observed_surface(space, i) for i in range(3)]
    targets = tuple(exact_target(surface, displacement[surface.points]) for surface in surfaces)
    problem = InverseProblem((model,), (targets,), mapping, frozenset({"gland", "sac"}))
    return Twin(problem, moduli, coefficients, displacement, space)


def settings(*ratios, method="gauss-newton", law=None, limits=(0.02, 200.0), n=2) -> InversionSettings:
    starts = tuple(np.full(n, np.log(ratio)) for ratio in ratios)
    return InversionSettings(starts, Bounds(np.full(n, np.log(limits[0])), np.full(n, np.log(limits[1]))), method, law)
