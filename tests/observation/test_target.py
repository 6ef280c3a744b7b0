"""Targets: quadrature on the observed part, and the later surface at the level of the rest surface."""

from __future__ import annotations

import numpy as np
import pytest

from palpate.images.distance import distance_map, terrace_noise
from palpate.images.label_image import VoxelGrid
from palpate.observation.observed_surface import ObservedSurface
from palpate.observation.surface_residuals import correspondence
from palpate.observation.target import surface_target, target_from
from palpate.phantoms.shapes import ball

GRID = VoxelGrid((32, 32, 32), np.array([[1.0, 0, 0, -15.3], [0, 1, 0, -15.6], [0, 0, 1, -15.4], [0, 0, 0, 1.0]]))


def image(centre, radius):
    index = np.stack(np.meshgrid(*[np.arange(32.0)] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
    inside = np.linalg.norm(GRID.world(index) - centre, axis=1) < radius
    return distance_map(inside.reshape(GRID.shape), GRID, smoothing_mm=0.6)


@pytest.fixture(scope="module")
def surface(sphere):
    vertices, triangles = sphere(2)
    seen = vertices[triangles][..., 0].mean(axis=1) > 0.0
    rim = np.zeros((len(triangles), 3), dtype=bool)
    return ObservedSurface(0, "ball", np.arange(len(vertices)), 9.0 * vertices, triangles, seen, rim, 0.5)


@pytest.fixture(scope="module")
def maps():
    return image(np.zeros(3), 9.0), image(np.array([1.0, 0.0, 0.0]), 10.0)


def test_surfaces_along_the_voxels_planes_are_noisier(surface, maps):
    target = surface_target(surface, *maps)
    normals = np.cross(*np.diff(surface.rest[surface.triangles[target.triangle]], axis=1).swapaxes(0, 1))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    steepest = np.abs(normals).max(axis=1)
    assert target.terraces[steepest.argmax()] > 20.0 * target.terraces[steepest < 0.8].max()


def test_the_rounding_at_image_points_is_judged_by_the_models_smooth_surface(sphere, maps):
    """The image's own normals are noisy with the rounding itself: weights made of them would go with the errors."""
    vertices, triangles = sphere(3)
    everywhere, rim = np.ones(len(triangles), dtype=bool), np.zeros((len(triangles), 3), dtype=bool)
    whole = ObservedSurface(0, "ball", np.arange(len(vertices)), 9.0 * vertices, triangles, everywhere, rim, 1.0)
    target = surface_target(whole, maps[0], maps[0])
    found = correspondence(target, np.zeros_like(whole.rest)).terraces
    radial = target.image_points / np.linalg.norm(target.image_points, axis=1, keepdims=True)
    assert np.corrcoef(found, terrace_noise(maps[0], maps[0], radial))[0, 1] > 0.99


def test_quadrature_covers_the_observed_part_only(surface, maps):
    target = target_from(surface, *maps, level=0.0, image=(np.zeros((0, 3)), np.zeros(0)))
    assert surface.observed[target.triangle].all()
    corners = surface.rest[surface.triangles[surface.observed]]
    whole = 0.5 * np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1).sum()
    assert target.area.sum() == pytest.approx(whole)
    places = np.einsum("qk,qka->qa", target.barycentric, surface.rest[surface.triangles[target.triangle]])
    middle = np.average(places, axis=0, weights=target.area)
    expected = np.average(
        corners.mean(axis=1),
        axis=0,
        weights=np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1),
    )
    assert middle == pytest.approx(expected)


def test_the_level_is_the_mean_of_the_map_before(surface, maps):
    target = surface_target(surface, *maps)
    assert target.level == pytest.approx(np.average(target.rest_distance, weights=target.area))
    assert -0.4 < target.level < -0.05  # facets lie inside of their sphere


def test_the_later_surface_is_taken_at_that_level(surface, maps):
    target = surface_target(surface, *maps)
    errors = maps[1].at(target.image_points) - target.level
    assert np.sqrt(np.average(errors**2, weights=target.image_area)) < 5e-3
    radius = np.linalg.norm(target.image_points - [1.0, 0.0, 0.0], axis=1)
    assert np.mean(radius) == pytest.approx(10.0 + target.level, abs=0.05)


def test_a_common_bias_leaves_the_later_surface_where_it_was(surface, maps):
    plain, biased = (surface_target(surface, *[m.shifted(bias) for m in maps]) for bias in (0.0, -0.5))
    assert biased.level == pytest.approx(plain.level - 0.5)
    assert biased.image_points == pytest.approx(plain.image_points, abs=1e-9)
    assert biased.image_area == pytest.approx(plain.image_area, abs=1e-9)


def test_any_distance_and_any_points_make_a_target(surface):
    points, areas = np.eye(3) * 10.0, np.array([1.0, 2.0, 3.0])
    target = target_from(surface, ball(np.zeros(3), 9.0), ball(np.zeros(3), 10.0), level=0.2, image=(points, areas))
    assert target.level == 0.2
    assert target.image_points is points
    assert target.image_area is areas
    assert np.all(target.rest_distance < 0.0)
