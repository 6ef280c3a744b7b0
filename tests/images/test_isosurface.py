"""Points on a level surface of a distance map, and the area that they stand for."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import ndimage
from scipy.spatial.transform import Rotation

from palpate.images.distance import DistanceMap, distance_map, isosurface_points
from palpate.images.label_image import VoxelGrid

CENTRE = np.array([0.3, -0.4, 0.2])


def grid_of(spacing=(1.0, 1.0, 1.0), turn=(0.0, 0.0, 0.0), extent=32.0, mirrored=False) -> VoxelGrid:
    shape = np.ceil(extent / np.array(spacing)).astype(int)
    axes = Rotation.from_rotvec(turn).as_matrix() * spacing
    if mirrored:
        axes[:, 0] *= -1.0
    affine = np.eye(4)
    affine[:3, :3], affine[:3, 3] = axes, -axes @ (shape - 1) / 2.0
    return VoxelGrid(tuple(int(n) for n in shape), affine)


def places_of(grid):
    index = np.stack(np.meshgrid(*[np.arange(float(n)) for n in grid.shape], indexing="ij"), axis=-1).reshape(-1, 3)
    return grid.world(index)


def exact_map(grid, distance) -> DistanceMap:
    """The map that interpolates an analytic distance."""
    values = distance(places_of(grid)).reshape(grid.shape)
    return DistanceMap(ndimage.spline_filter(values, order=3, mode="mirror"), grid)


def from_ball(points, radius=10.0):
    return np.linalg.norm(points - CENTRE, axis=1) - radius


GRIDS = {
    "cubic": grid_of(),
    "anisotropic": grid_of((1.0, 1.0, 1.5)),
    "oblique": grid_of(turn=(0.3, -0.5, 0.2)),
    "left-handed": grid_of((0.8, 1.0, 1.2), mirrored=True),
}


@pytest.fixture(params=sorted(GRIDS))
def image(request):
    return exact_map(GRIDS[request.param], from_ball)


@pytest.mark.parametrize("level", [-2.0, 0.0, 1.5])
def test_the_area_of_a_ball_is_found(image, level):
    area = isosurface_points(image, level).area.sum()
    assert area == pytest.approx(4.0 * np.pi * (10.0 + level) ** 2, rel=0.005)


@pytest.mark.parametrize("level", [-2.0, 0.0, 1.5])
def test_points_lie_on_the_level(image, level):
    points = isosurface_points(image, level)
    errors = image.at(points.places) - level
    assert np.sqrt(np.average(errors**2, weights=points.area)) < 1e-3
    assert np.abs(errors).max() < 0.05  # on edges that graze the surface, which have next to no weight
    assert np.linalg.norm(points.places - CENTRE, axis=1) == pytest.approx(10.0 + level, abs=0.05)


def test_a_surface_made_of_voxels_has_its_area_but_for_their_ripple():
    for grid in GRIDS.values():
        mask = (from_ball(places_of(grid)) < 0.0).reshape(grid.shape)
        points = isosurface_points(distance_map(mask, grid, smoothing_mm=0.6 * float(grid.spacing.max())))
        assert points.area.sum() == pytest.approx(4.0 * np.pi * 10.0**2, rel=0.1)
        assert np.std(np.linalg.norm(points.places - CENTRE, axis=1)) < 0.15


def test_normals_point_out_of_the_tissue(image):
    points = isosurface_points(image)
    outwards = (points.places - CENTRE) / np.linalg.norm(points.places - CENTRE, axis=1, keepdims=True)
    assert points.normals == pytest.approx(outwards, abs=0.02)


def test_areas_weigh_every_side_of_a_ball_alike(image):
    points = isosurface_points(image)
    centre = np.average(points.places, axis=0, weights=points.area)
    assert centre == pytest.approx(CENTRE, abs=0.02)
    moment = np.average((points.places - CENTRE) ** 2, axis=0, weights=points.area)
    assert moment == pytest.approx(10.0**2 / 3.0, rel=0.01)


@pytest.mark.parametrize("normal", [(1.0, 0.0, 0.0), (1.0, 1.0, 0.0), (3.0, -2.0, 1.0)])
def test_the_area_of_a_plane_is_found(normal):
    """Inside a cylinder across it, away from the image's border."""
    direction = np.array(normal) / np.linalg.norm(normal)
    grid = grid_of(extent=40.0)
    points = isosurface_points(exact_map(grid, lambda p: p @ direction - 0.37))
    aside = np.linalg.norm(points.places - np.outer(points.places @ direction, direction), axis=1)
    assert points.area[aside < 14.0].sum() == pytest.approx(np.pi * 14.0**2, rel=0.01)


def test_the_bias_of_a_map_moves_its_level():
    image = exact_map(grid_of(), from_ball)
    plain, biased = isosurface_points(image, 0.4), isosurface_points(image.shifted(0.7), 1.1)
    assert biased.places == pytest.approx(plain.places, abs=1e-9)


def test_nothing_is_taken_from_the_borders_continuation():
    """A ball that the image cuts: no point within a voxel of the border, where the map is not measured."""
    grid = grid_of(extent=16.0)
    points = isosurface_points(exact_map(grid, lambda p: np.linalg.norm(p - [6.0, 0.0, 0.0], axis=1) - 6.0))
    index = grid.index(points.places)
    assert index.min() > 0.4
    assert np.all(index < np.array(grid.shape) - 1.4)
    assert 0.0 < points.area.sum() < 4.0 * np.pi * 6.0**2


def test_a_level_that_the_map_does_not_reach_has_no_points():
    assert len(isosurface_points(exact_map(grid_of(), from_ball), 1e3).area) == 0
