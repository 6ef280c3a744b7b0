"""The distance map of a tissue is that of the whole image, on the part of it that matters."""

from __future__ import annotations

import numpy as np
import pytest

from palpate.errors import InputDataError
from palpate.images.distance import REACH_MM, cropped, distance_map, tissue_distance_map, window_around
from palpate.images.label_image import VoxelGrid
from palpate.images.segmentation import Segmentation
from palpate.images.tissue import Role, Tissue

TISSUES = (
    Tissue("organ", Role.ESTIMATE, (1,)),
    Tissue("rest", Role.KNOWN, youngs_modulus_kpa=1.0),
    Tissue("lost", Role.ESTIMATE, (2,)),
)
AFFINE = np.array([[-1.2, 0.0, 0.0, 60.0], [0.0, 0.0, 1.0, -30.0], [0.0, 1.5, 0.0, -40.0], [0.0, 0.0, 0.0, 1.0]])
GRID = VoxelGrid((90, 60, 80), AFFINE)


@pytest.fixture(scope="module")
def centre():
    return GRID.world(np.array([[45.0, 30.0, 40.0]]))[0]


@pytest.fixture(scope="module")
def segmentation(centre):
    index = np.stack(np.meshgrid(*[np.arange(float(n)) for n in GRID.shape], indexing="ij"), axis=-1).reshape(-1, 3)
    inside = np.linalg.norm(GRID.world(index) - centre, axis=1) < 8.0
    return Segmentation(np.where(inside, 0, 1).reshape(GRID.shape), GRID, TISSUES)


def around(centre, distance, n=300):
    vectors = np.random.default_rng(3).standard_normal((n, 3))
    return centre + distance * vectors / np.linalg.norm(vectors, axis=1, keepdims=True)


def test_it_equals_the_map_of_the_whole_image(segmentation, centre):
    part = tissue_distance_map(segmentation, 0, smoothing_mm=0.9)
    whole = distance_map(segmentation.mask(0), GRID, smoothing_mm=0.9)
    assert np.prod(part.grid.shape) < 0.7 * np.prod(GRID.shape)
    for distance, tolerance in ((2.0, 1e-6), (8.0, 1e-6), (12.0, 1e-6), (25.0, 1e-3)):
        points = around(centre, distance)
        assert part.at(points) == pytest.approx(whole.at(points), abs=tolerance)


def test_it_is_the_distance_to_the_surface(segmentation, centre):
    part = tissue_distance_map(segmentation, 0, smoothing_mm=0.9)
    for distance in (6.0, 8.0, 10.0):
        assert part.at(around(centre, distance)).mean() == pytest.approx(distance - 8.0, abs=0.2)


def test_it_reaches_as_far_as_an_organ_may_move(segmentation, centre):
    part = tissue_distance_map(segmentation, 0, smoothing_mm=0.9)
    index = part.grid.index(around(centre, 8.0 + REACH_MM - 2.0))
    assert index.min() >= 0.0
    assert np.all(index <= np.array(part.grid.shape) - 1.0)


def test_a_cropped_grid_keeps_its_places():
    window = (slice(5, 20), slice(0, 7), slice(60, 80))
    part = cropped(GRID, window)
    assert part.shape == (15, 7, 20)
    assert part.spacing == pytest.approx(GRID.spacing)
    index = np.array([[0.0, 0.0, 0.0], [14.0, 6.0, 19.0]])
    assert part.world(index) == pytest.approx(GRID.world(index + np.array([5.0, 0.0, 60.0])))


def test_a_tissue_that_is_not_in_the_image_is_named(segmentation):
    with pytest.raises(InputDataError, match="'lost' has no voxel"):
        tissue_distance_map(segmentation, 2, smoothing_mm=0.9)


@pytest.mark.parametrize("seed", range(5))
def test_a_window_is_the_least_box_that_holds_a_mask_and_its_margin_within_the_image(seed):
    rng = np.random.default_rng(seed)
    mask = np.zeros(tuple(rng.integers(4, 20, 3)), dtype=bool)
    mask[tuple(rng.integers(0, n, 3) for n in mask.shape)] = True
    grid = VoxelGrid(mask.shape, np.diag([1.0, 2.0, 1.5, 1.0]))
    tight, wide = window_around(mask, grid), window_around(mask, grid, reach_mm=3.2)
    assert np.count_nonzero(mask[tight]) == np.count_nonzero(mask)
    assert all(mask[tight].any(axis=tuple({0, 1, 2} - {a}))[[0, -1]].all() for a in range(3))
    for inner, outer, margin, n in zip(tight, wide, (4, 2, 3), mask.shape, strict=True):
        assert (outer.start, outer.stop) == (max(inner.start - margin, 0), min(inner.stop + margin, n))
