"""Surface residuals: derivatives of smooth surfaces, and nothing but the difference to the rest state."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from palpate.images.distance import distance_map
from palpate.images.label_image import VoxelGrid
from palpate.mesh.space import shape_functions
from palpate.mesh.surface import triangle_normals
from palpate.observation.observed_surface import SUBTRIANGLES, ObservedSurface
from palpate.observation.surface_residuals import Correspondence, correspondence, surface_residuals
from palpate.observation.target import surface_target, target_from
from palpate.phantoms.shapes import Ellipsoid, ball, rotation_about

RADIUS = 10.0
CENTRE = np.array([0.3, -0.2, 0.4])


def surface_of(vertices, triangles, observed=None, rim=None) -> ObservedSurface:
    n = len(triangles)
    seen = np.ones(n, dtype=bool) if observed is None else observed
    edges = np.zeros((n, 3), dtype=bool) if rim is None else rim
    return ObservedSurface(0, "ball", np.arange(len(vertices)), CENTRE + RADIUS * vertices, triangles, seen, edges, 1.0)


def directions(rng, n):
    vectors = rng.standard_normal((n, 3))
    return vectors / np.linalg.norm(vectors, axis=1, keepdims=True)


def smooth_target(surface, rng, n=400):
    """Two ellipsoids that are neither the model nor each other."""
    before = Ellipsoid(CENTRE, np.array([10.6, 9.7, 10.2]), rotation_about(np.array([1.0, 2.0, 3.0]), 30.0))
    after = Ellipsoid(CENTRE + np.array([0.8, -0.5, 0.3]), np.array([9.4, 10.9, 10.4]), before.rotation)
    points = after.surface(directions(rng, n))
    return target_from(surface, before, after, level=0.1, image=(points, np.full(n, 3.0)))


def everywhere(target):
    """All image points count; the maps' smoothing draws nothing in."""
    n = len(target.image_points)
    return Correspondence(np.ones(n, dtype=bool), np.zeros(n), np.zeros(len(target.surface.rest)))


@pytest.fixture(scope="module")
def ball_surface(sphere):
    return surface_of(*sphere(2))


def slope_of(target, motion, h=1e-4):
    """Central differences of the residuals at rest along a motion (n_vertices, 3)."""
    high, low = (surface_residuals(target, sign * h * motion, everywhere(target)).values for sign in (1.0, -1.0))
    return (high - low) / (2.0 * h)


def test_the_jacobian_is_that_of_the_residuals_of_a_smooth_surface(sphere, rng):
    surface = surface_of(*sphere(4))
    before, after = ball(CENTRE, 10.0), ball(CENTRE, 10.7)
    points = CENTRE + 10.7 * directions(rng, 600)
    target = target_from(surface, before, after, level=0.0, image=(points, np.ones(600)))
    motion = np.stack([np.sin(surface.rest[:, 0] / 5.0), surface.rest[:, 1] / 9.0, np.ones(len(surface.rest))], axis=1)
    jacobian = surface_residuals(target, np.zeros_like(surface.rest), everywhere(target)).jacobian
    exact, n = slope_of(target, motion), len(target.area)
    off = exact - jacobian @ motion.ravel()
    assert np.linalg.norm(off[:n]) < 0.02 * np.linalg.norm(exact[:n])
    assert np.linalg.norm(off[n:]) < 0.05 * np.linalg.norm(exact[n:])


def test_the_jacobian_knows_no_sliding(sphere):
    """What residuals change by a motion along the surface is noise of the voxels."""
    surface = surface_of(*sphere(4))
    spin = np.cross([0.0, 0.0, 0.2], surface.rest - CENTRE)
    target = smooth_target(surface, np.random.default_rng(1))
    jacobian = surface_residuals(target, np.zeros_like(surface.rest), everywhere(target)).jacobian
    assert np.linalg.norm(jacobian @ spin.ravel()) < 0.1 * np.linalg.norm(slope_of(target, spin))


def test_a_model_that_moves_with_the_image_has_no_misfit(ball_surface):
    shift = np.array([1.5, -0.7, 0.4])
    before = Ellipsoid(CENTRE, np.array([10.6, 9.7, 10.2]), np.eye(3))
    after = Ellipsoid(CENTRE + shift, before.semi_axes, np.eye(3))
    corners = ball_surface.rest[ball_surface.triangles].mean(axis=1)
    points = corners + shift  # of the model itself, on which `after` is not zero: only the difference counts
    target = target_from(ball_surface, before, after, level=0.0, image=(points, np.ones(len(points))))
    moved = surface_residuals(target, np.tile(shift, (len(ball_surface.rest), 1)), everywhere(target))
    assert np.abs(moved.values[: len(target.area)]).max() < 1e-10
    assert moved.values[len(target.area) :] == pytest.approx(-before.at(corners), abs=1e-10)


def voxel_map(shift=0.0, radius=10.3):
    grid = VoxelGrid((34, 34, 34), np.array([[1.0, 0, 0, -16.6], [0, 1, 0, -16.3], [0, 0, 1, -16.4], [0, 0, 0, 1.0]]))
    index = np.stack(np.meshgrid(*[np.arange(34.0)] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
    inside = np.linalg.norm(grid.world(index) - CENTRE - [shift, 0.0, 0.0], axis=1) < radius
    return distance_map(inside.reshape(grid.shape), grid, smoothing_mm=0.6)


def test_facets_are_no_misfit_when_nothing_moved(ball_surface):
    image = voxel_map()
    target = surface_target(ball_surface, image, image)
    still = surface_residuals(target, np.zeros_like(ball_surface.rest), everywhere(target))
    n = len(target.area)
    assert np.array_equal(still.values[:n], np.zeros(n))
    to_facets = np.linalg.norm(still.places[n:] - target.image_points, axis=1)
    assert np.sqrt(np.mean(still.values[n:] ** 2)) < 0.15 * np.sqrt(np.mean(to_facets**2))


def test_a_shift_towards_the_image_has_the_sign_of_the_distance(ball_surface, rng):
    """Where the model lies outside of the later surface, both directions give a positive residual."""
    before, after = ball(CENTRE, 10.0), ball(CENTRE, 9.0)
    target = target_from(
        ball_surface, before, after, level=0.0, image=(CENTRE + 9 * directions(rng, 200), np.ones(200))
    )
    still = surface_residuals(target, np.zeros_like(ball_surface.rest), everywhere(target))
    assert still.values == pytest.approx(1.0, abs=0.1)
    grown = surface_residuals(target, 0.3 * (ball_surface.rest - CENTRE) / RADIUS, everywhere(target))
    assert np.all(grown.values > still.values + 0.2)


def test_each_direction_has_half_of_the_weight(ball_surface, rng):
    target = smooth_target(ball_surface, rng)
    held = everywhere(target)
    held.kept[::3] = False
    found = surface_residuals(target, np.zeros_like(ball_surface.rest), held)
    n = len(target.area)
    assert found.weights[:n].sum() == pytest.approx(0.5)
    assert found.weights[n:].sum() == pytest.approx(0.5)
    assert len(found.values) == n + held.kept.sum()


def test_image_points_that_face_the_hidden_part_are_dropped(sphere, rng):
    vertices, triangles = sphere(3)
    upper = vertices[triangles][..., 2].mean(axis=1) > 0.0
    equator = np.abs(vertices[:, 2]) < 1e-12
    on_rim = np.stack([equator[triangles[:, [1, 2]]], equator[triangles[:, [0, 2]]], equator[triangles[:, [0, 1]]]], 1)
    surface = surface_of(vertices, triangles, upper, on_rim.all(axis=2) & upper[:, None])
    towards = directions(rng, 500)
    points = CENTRE + 10.5 * towards
    shape = ball(CENTRE, 10.5)
    target = target_from(surface, shape, shape, level=0.0, image=(points, np.ones(500)))
    held = correspondence(target, np.zeros_like(surface.rest))
    assert np.all(towards[held.kept, 2] > 0.0)
    assert held.kept[towards[:, 2] > 0.1].all()  # nearer to the rim, the rim itself is closest
    below = surface_residuals(target, np.zeros_like(surface.rest), held)
    assert below.places[:, 2].min() > CENTRE[2] - 1e-9


@pytest.mark.parametrize("grown", [0.5, 1.6])
def test_a_ball_of_voxels_that_shrinks_or_grows_is_met_where_it_is(sphere, grown):
    """The maps' smoothing draws a small ball in further than a large one, by sigma^2 / R."""
    vertices, triangles = sphere(5)
    whole = replace(surface_of(vertices, triangles), rest=RADIUS * vertices)
    grid = VoxelGrid((48, 48, 48), np.array([[1.0, 0, 0, -23.4], [0, 1, 0, -23.7], [0, 0, 1, -23.2], [0, 0, 0, 1]]))
    centres = grid.world(np.indices(grid.shape).reshape(3, -1).T.astype(float))
    radii = np.linalg.norm(centres, axis=1).reshape(grid.shape)
    maps = [distance_map(radii < radius, grid, smoothing_mm=1.0) for radius in (RADIUS, grown * RADIUS)]
    target = surface_target(whole, *maps)
    motion = (grown - 1.0) * whole.rest
    held = correspondence(target, motion)
    drawn = 1.0 / (grown * RADIUS) - 1.0 / RADIUS
    assert held.excess.mean() == pytest.approx(drawn, rel=0.05)
    met = surface_residuals(target, motion, held)
    missed = surface_residuals(target, motion, replace(held, excess=np.zeros(len(vertices))))
    for found, by in ((met, 0.0), (missed, drawn)):
        for part in (slice(0, len(target.area)), slice(len(target.area), None)):
            mean = np.average(found.values[part], weights=found.weights[part])
            assert mean == pytest.approx(by, abs=0.2 * abs(drawn) + 2e-3)


def test_curved_faces_bulge_by_the_volume_between_them_and_their_plane_pieces(sphere):
    """Without smoothing the excess is minus the mean height of a quadratic face over its four triangles."""
    corners, coarse = sphere(2)
    edges = np.stack([coarse, np.roll(coarse, -1, axis=1)], axis=2)  # 01, 12, 20
    pairs, number = np.unique(np.sort(edges, axis=2).reshape(-1, 2), axis=0, return_inverse=True)
    rest = RADIUS * np.concatenate([corners, corners[pairs].mean(axis=1)])
    faces = np.concatenate([coarse, len(corners) + number.reshape(-1, 3)], axis=1)
    triangles = faces[:, SUBTRIANGLES].reshape(-1, 3)
    surface = replace(surface_of(rest, triangles), rest=rest, faces=faces)
    onto = RADIUS * rest / np.linalg.norm(rest, axis=1, keepdims=True) - rest  # the middles reach the ball, too
    grid = VoxelGrid((30, 30, 30), np.array([[1.0, 0, 0, -14.4], [0, 1, 0, -14.7], [0, 0, 1, -14.2], [0, 0, 0, 1]]))
    centres = grid.world(np.indices(grid.shape).reshape(3, -1).T.astype(float))
    image = distance_map((np.linalg.norm(centres, axis=1) < RADIUS).reshape(grid.shape), grid, smoothing_mm=1.0)
    sharp = replace(image, smoothing_mm=0.0)
    held = correspondence(replace(surface_target(surface, image, image), voxels=(sharp, sharp)), onto)
    shares = np.bincount(triangles.ravel(), np.repeat(areas(rest + onto, triangles), 3) / 3.0, len(rest))
    between = curved_volume(rest + onto, faces, 12) - volume(rest + onto, triangles)
    assert -shares @ held.excess == pytest.approx(between, rel=0.03)
    assert held.excess.max() < 0.0
    still = correspondence(replace(surface_target(surface, image, image), voxels=(sharp, sharp)), np.zeros_like(rest))
    assert np.abs(still.excess).max() < 1e-12


def areas(vertices, triangles):
    return np.linalg.norm(triangle_normals(vertices, triangles), axis=1)


def volume(vertices, triangles):
    """Volume within a closed surface."""
    return np.einsum("ta,ta->", vertices[triangles].mean(axis=1), triangle_normals(vertices, triangles)) / 3.0


def curved_volume(vertices, faces, n):
    """Volume within quadratic faces, each split into n^2 plane triangles."""
    lattice = [(i, j) for i in range(n + 1) for j in range(n + 1 - i)]
    number = {place: k for k, place in enumerate(lattice)}
    cells = [(number[i, j], number[i + 1, j], number[i, j + 1]) for i, j in lattice if i + j < n]
    cells += [(number[i + 1, j], number[i + 1, j + 1], number[i, j + 1]) for i, j in lattice if i + j < n - 1]
    b1, b2 = np.array(lattice).T / n
    points = np.einsum("lk,fka->fla", shape_functions(2, np.column_stack([1.0 - b1 - b2, b1, b2])), vertices[faces])
    pieces = points[:, np.array(cells)].reshape(-1, 3, 3)
    return volume(pieces.reshape(-1, 3), np.arange(3 * len(pieces)).reshape(-1, 3))
