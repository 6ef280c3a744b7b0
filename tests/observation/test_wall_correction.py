"""The finer motion of a wall: found from its own surface, nothing where nothing is left, the same when found again."""

from __future__ import annotations

import numpy as np
import pytest

from palpate.mesh.surface import vertex_normals
from palpate.observation.contract import Residuals
from palpate.observation.observed_surface import ObservedSurface
from palpate.observation.surface_residuals import Correspondence, surface_residuals
from palpate.observation.target import target_from
from palpate.observation.wall_correction import wall_correction
from palpate.phantoms.shapes import ball

RADIUS = 12.0
KERNEL_MM, PRIOR_MM = 6.0, 0.3
PRECISION = 1e4  # mm^-2


@pytest.fixture(scope="module")
def wall(sphere):
    vertices, triangles = sphere(3)
    n = len(triangles)
    seen, rim = np.ones(n, dtype=bool), np.zeros((n, 3), dtype=bool)
    return ObservedSurface(0, "wall", np.arange(len(vertices)), RADIUS * vertices, triangles, seen, rim, 1.0)


def bump(wall):
    """A normal motion of 0.4 mm within 6 mm of a pole."""
    distance2 = np.sum((wall.rest - [0.0, 0.0, RADIUS]) ** 2, axis=1)
    normals = vertex_normals(wall.rest, wall.triangles)
    return 0.4 * np.exp(-distance2 / (2.0 * KERNEL_MM**2))[:, None] * normals


def residuals_of(wall, displacement) -> Residuals:
    """The later image is the resting ball: a wall that has moved should go back."""
    still = ball(np.zeros(3), RADIUS)
    target = target_from(wall, still, still, level=0.0, image=(wall.rest[::4], np.full(len(wall.rest[::4]), 4.0)))
    n = len(target.image_points)
    held = Correspondence(np.ones(n, dtype=bool), np.zeros(n), np.zeros(len(wall.rest)))
    return surface_residuals(target, displacement, held)


def correction(wall, displacement, present):
    residuals = residuals_of(wall, displacement)
    precision = np.full(len(residuals.values), PRECISION)
    return wall_correction(wall, residuals, precision, present=present, kernel_mm=KERNEL_MM, prior_mm=PRIOR_MM)


def test_a_motion_that_the_modes_left_is_found(wall):
    moved = bump(wall)
    found = correction(wall, moved, np.zeros_like(moved))
    assert np.abs(found + moved).max() < 0.04


def test_nothing_is_added_to_a_wall_that_fits(wall):
    still = np.zeros_like(wall.rest)
    assert np.abs(correction(wall, still, still)).max() < 5e-3


def test_a_correction_found_again_is_the_same(wall):
    moved = bump(wall)
    first = correction(wall, moved, np.zeros_like(moved))
    assert correction(wall, moved + first, first) == pytest.approx(first, abs=0.02)
