"""The images behind the slices: every voxel at its place, whatever the axes of the image."""

from __future__ import annotations

import numpy as np
import pytest

from palpate.images.label_image import VoxelGrid
from palpate.images.segmentation import Segmentation
from palpate.images.tissue import Role, Tissue
from palpate.report.report_data import SliceBox
from palpate.report.volume import grey_volume, label_volume

GRID = VoxelGrid((40, 30, 20), np.array([[0, 2.0, 0, -5.0], [1.5, 0, 0, -5.0], [0, 0, -3.0, 50.0], [0, 0, 0, 1]]))
BOX = SliceBox(np.array([0.0, 2.0, 5.0]), np.array([40.0, 45.0, 44.0]), np.array([20.0, 20.0, 20.0]))


def places(volume):
    index = np.stack(np.meshgrid(*[np.arange(n) for n in volume.values.shape], indexing="ij"), axis=-1)
    return volume.grid.world(index.reshape(-1, 3).astype(float))


def test_a_linear_grey_image_stays_linear_in_world_coordinates():
    index = np.stack(np.meshgrid(*[np.arange(n) for n in GRID.shape], indexing="ij"), axis=-1).reshape(-1, 3)
    slope = np.array([1.0, 0.7, -0.4])
    volume = grey_volume((GRID.world(index.astype(float)) @ slope).reshape(GRID.shape), GRID, BOX)
    shade, value = volume.values.ravel().astype(float), places(volume) @ slope
    inside = (shade > 0) & (shade < 255)
    fit = np.polyfit(value[inside], shade[inside], 1)
    assert np.abs(np.polyval(fit, value[inside]) - shade[inside]).max() < 1.0
    np.testing.assert_allclose(volume.grid.world(np.array(volume.values.shape, float)[None] - 1)[0], BOX.high)


def test_labels_are_those_of_the_nearest_voxel():
    index = np.random.default_rng(5).integers(0, 3, GRID.shape).astype(np.int16)
    image = Segmentation(index, GRID, tuple(Tissue(str(i), Role.VOID, (i,)) for i in range(3)))
    volume = label_volume(image, BOX)
    place = GRID.index(places(volume))
    inside = ((place > 0) & (place < np.array(GRID.shape) - 1)).all(axis=1)
    clear = (np.abs(place % 1.0 - 0.5) > 1e-3).all(axis=1) & inside  # between two voxels, either is the nearest
    assert clear.sum() > 1000
    expected = index[tuple(np.rint(place[clear]).astype(int).T)] + 1
    np.testing.assert_array_equal(volume.values.ravel()[clear], expected)


def test_outside_of_the_image_there_is_nothing():
    far = SliceBox(BOX.low + 500.0, BOX.high + 500.0, BOX.position)
    assert not grey_volume(np.ones(GRID.shape), GRID, far).values.any()


@pytest.mark.parametrize("most", [1000, 20_000])
def test_a_large_box_is_sampled_more_coarsely(most):
    assert grey_volume(np.ones(GRID.shape), GRID, BOX, most_voxels=most).values.size < 1.5 * most
