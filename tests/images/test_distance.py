"""A distance map's value and gradient by one look-up: SciPy's spline, and its slope, on an oblique grid."""

from __future__ import annotations

import numpy as np
import pytest

from palpate.images.distance import DistanceMap
from palpate.images.label_image import VoxelGrid

STEP_MM = 1e-5
AFFINE = np.array([[-1.2, 0.3, 0.0, 60.0], [0.2, 0.0, 1.0, -30.0], [0.0, 1.5, 0.1, -40.0], [0.0, 0.0, 0.0, 1.0]])


@pytest.fixture(scope="module")
def rough():
    """Coefficients without any order, so that every node of a stencil counts."""
    grid = VoxelGrid((9, 7, 8), AFFINE)
    return DistanceMap(np.random.default_rng(4).standard_normal(grid.shape), grid, bias=0.7)


def places(rough, low, high, n=400):
    return rough.grid.world(np.random.default_rng(5).uniform(low, high, (n, 3)) * np.array(rough.grid.shape))


@pytest.mark.parametrize(("low", "high"), [(0.2, 0.8), (0.0, 1.0), (-0.5, 1.5)], ids=["inside", "border", "beyond"])
def test_the_value_is_that_of_the_spline(rough, low, high):
    points = places(rough, low, high)
    assert rough.values_and_gradients(points)[0] == pytest.approx(rough.at(points), abs=1e-13)


def test_the_gradient_is_the_slope_of_the_values(rough):
    points = places(rough, 0.05, 0.85)
    steps = STEP_MM * np.eye(3)
    slope = np.stack([(rough.at(points + s) - rough.at(points - s)) / (2.0 * STEP_MM) for s in steps], axis=1)
    assert rough.values_and_gradients(points)[1] == pytest.approx(slope, abs=1e-7)
    assert np.array_equal(rough.gradient_at(points), rough.values_and_gradients(points)[1])


def test_no_points_have_no_values(rough):
    values, gradients = rough.values_and_gradients(np.zeros((0, 3)))
    assert (values.shape, gradients.shape) == ((0,), (0, 3))
