"""The hollow concentric organs of B4 as an inverse problem whose images are the closed form itself: no mesh made them.

Radii 5, 10, 20, 30 mm, nu = 0.4; E = 50 and 100 kPa are sought, the outer 150 kPa are known. The cavity grows by 1 mm.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from palpate.inversion import Bounds, InverseProblem, InversionSettings, LaterState
from palpate.mechanics import LinearModel, linear_model, triangle_quadrature
from palpate.mesh import LevelSet, lagrange_space, triangle_normals
from palpate.observation import (
    NoiseModel,
    observed_surface,
    surface_distance,
    target_from,
)
from palpate.phantoms import SmoothField
from palpate.unknowns import parameter_map, unit_blocks
from palpate_validation.conditions import held_components, sphere_faces
from palpate_validation.structured_meshes import known, octant_mesh, unknown

__all__ = ["TRUTH", "SphericalShell", "Warped", "noise_of", "settings_from", "twin_model", "twin_problem"]

Array = NDArray[np.float64]

TRUTH = np.array([50.0, 100.0, 150.0])  # kPa
PUSH = 1.0  # mm
LATER = (10.0 + 0.193361, 20.0 + 0.029300)  # radii of core and middle then, mm: see B4a


@dataclass(frozen=True, slots=True)
class SphericalShell:
    """Signed distance to the shell between two radii (mm), negative inside."""

    inner: float
    outer: float

    def at(self, points: Array) -> Array:
        """Distance (n,) mm at points (n, 3) mm."""
        r = np.linalg.norm(points, axis=1)
        return np.asarray(np.maximum(r - self.outer, self.inner - r))

    def gradient_at(self, points: Array) -> Array:
        """Gradient (n, 3) at points (n, 3) mm."""
        r = np.linalg.norm(points, axis=1)
        away = np.where(r - self.outer > self.inner - r, 1.0, -1.0)
        return np.asarray(away[:, None] * points / np.maximum(r, 1e-12)[:, None])


@dataclass(frozen=True, slots=True)
class Warped:
    """Another distance whose surface a smooth field has moved; the field's slope is left out of the gradient."""

    shape: LevelSet
    field: SmoothField

    def at(self, points: Array) -> Array:
        """Distance (n,) mm at points (n, 3) mm."""
        return self.shape.at(points - self.field.at(points))

    def gradient_at(self, points: Array) -> Array:
        """Gradient (n, 3) at points (n, 3) mm."""
        return self.shape.gradient_at(points - self.field.at(points))


def twin_model(n_surface: int = 8, *, outer_known: bool = True) -> LinearModel:
    """The model with n_surface cells along the edges of its eighth; `outer_known` False: no modulus is known.

    The flat sides are planes of symmetry, which `outer_constraint` would leave free beside tissues to be estimated.
    """
    outer = known("outer", 150.0, nu=0.4) if outer_known else unknown("outer", nu=0.4)
    tissues = [unknown("core", nu=0.4), unknown("middle", nu=0.4), outer]
    mesh = octant_mesh(np.array([5.0, 10.0, 20.0, 30.0]), [n_surface // 2] * 2 + [n_surface // 4], n_surface, tissues)
    space = lagrange_space(mesh, "P2")
    walls = np.unique(space.facets(mesh.boundary[mesh.beyond != -1]))
    cavity = walls[np.linalg.norm(space.points[walls], axis=1) < 7.0]
    held, motion = np.abs(space.points) < 1e-9, np.zeros_like(space.points)
    held[walls] = True
    motion[cavity] = PUSH * space.points[cavity] / 5.0
    return linear_model(space, held_components(held, motion))


def twin_problem(
    model: LinearModel, noise: SmoothField | None = None, *, stated_noise: NoiseModel | None = None
) -> InverseProblem:
    """Core and middle are observed; `noise` moves their later surfaces; stated_noise: that of the case."""
    shells = ((5.0, 10.0, 5.0 + PUSH, LATER[0]), (10.0, 20.0, LATER[0], LATER[1]))
    places, weights = triangle_quadrature(7)
    observations = []
    for tissue, (inner, outer, later_inner, later_outer) in enumerate(shells):
        points, areas = [], []
        for rest, later in ((inner, later_inner), (outer, later_outer)):
            faces = sphere_faces(model.space.mesh, rest)
            spread = np.einsum("qk,fki->fqi", places, model.space.mesh.nodes[faces]).reshape(-1, 3)
            points.append(later * spread / np.linalg.norm(spread, axis=1, keepdims=True))
            size = np.linalg.norm(triangle_normals(model.space.mesh.nodes, faces), axis=1)
            areas.append((size[:, None] * weights).ravel())
        image = np.concatenate(points)
        before, shell = SphericalShell(inner, outer), SphericalShell(later_inner, later_outer)
        after: LevelSet = shell
        if noise is not None:
            after, image = Warped(shell, noise), noise.warp(image)
        surface = observed_surface(model.space, tissue)
        target = target_from(surface, before, after, level=0.0, image=(image, np.concatenate(areas)))
        observations.append(surface_distance(target, stated_noise=stated_noise))
    mapping = parameter_map(model.space.mesh.tissues, model.regions, unit_blocks(model.n_modes))
    return InverseProblem((LaterState(model, tuple(observations)),), mapping)


def settings_from(start: Array, *, lower: float = 0.01, upper: float = 10.0) -> InversionSettings:
    """One start (n,) of the moduli over the known one, dimensionless, between the bounds."""
    n = len(start)
    return InversionSettings((np.log(start),), Bounds(np.full(n, np.log(lower)), np.full(n, np.log(upper))))


def noise_of(sd_mm: float, length_mm: float) -> NoiseModel:
    """Noise with a standard deviation and a correlation length, mm."""
    return NoiseModel(np.array([sd_mm**2]), np.array([length_mm]))
