import numpy as np
import pytest

from palpate.phantoms.shapes import Complement, Ellipsoid, Tube, Union, ball, rotation_about
from palpate_validation.mismatch import Grown

TURN = rotation_about(np.array([1.0, 2.0, -0.5]), 25.0)
ELLIPSOID = Ellipsoid(np.array([1.0, -2.0, 3.0]), np.array([17.0, 22.0, 28.0]), TURN)
KNOTS = np.array([[0.0, 3.0, -27.0], [0.0, -1.0, -9.0], [1.0, -2.0, 9.0], [0.5, 2.0, 27.0]])
TUBE = Tube(KNOTS, np.array([11.0, 11.5, 12.0, 11.2]))


def directions(n=500, seed=0):
    vectors = np.random.default_rng(seed).normal(size=(n, 3))
    return vectors / np.linalg.norm(vectors, axis=1, keepdims=True)


def test_distance_to_an_ellipsoid_is_exact_along_its_normals():
    on = ELLIPSOID.surface(directions())
    normal = ELLIPSOID.gradient_at(on)
    for step in (-6.0, 0.0, 15.0):
        assert ELLIPSOID.at(on + step * normal) == pytest.approx(step, abs=1e-5)
        assert ELLIPSOID.gradient_at(on + step * normal) == pytest.approx(normal, abs=1e-4)


def test_distance_to_a_ball_is_that_to_its_centre_less_the_radius():
    points = np.random.default_rng(1).normal(scale=20.0, size=(300, 3))
    assert ball(np.zeros(3), 10.0).at(points) == pytest.approx(np.linalg.norm(points, axis=1) - 10.0, abs=1e-5)


def test_centre_of_an_ellipsoid_is_the_smallest_semi_axis_deep():
    assert ELLIPSOID.at(ELLIPSOID.centre[None]) == pytest.approx(-17.0, abs=1e-4)


def test_straight_tube_is_a_capsule():
    knots = np.linspace([0.0, 0.0, -20.0], [0.0, 0.0, 20.0], 4)
    points = np.random.default_rng(2).uniform(-35.0, 35.0, (400, 3))
    beyond = np.maximum(np.abs(points[:, 2]) - 20.0, 0.0)
    capsule = np.linalg.norm(np.column_stack([points[:, :2], beyond]), axis=1) - 11.0
    assert Tube(knots, np.full(4, 11.0)).at(points) == pytest.approx(capsule, abs=1e-8)


def test_distance_to_a_curved_tube_is_nearly_euclidean():
    on = TUBE.surface(directions())
    assert TUBE.at(on) == pytest.approx(0.0, abs=0.02)
    assert np.linalg.norm(TUBE.gradient_at(on), axis=1) == pytest.approx(1.0, abs=0.02)


@pytest.mark.parametrize(
    "shape",
    [ELLIPSOID, TUBE, Complement(TUBE), Grown(TUBE, 3.0), Union([ELLIPSOID, ball(np.array([30.0, 0, 0]), 9.0)])],
)
def test_gradient_is_the_derivative_of_the_distance(shape):
    points = 40.0 * directions(200, seed=3)
    step = 1e-3 * directions(200, seed=4)
    change = (shape.at(points + step) - shape.at(points - step)) / 2.0
    assert change == pytest.approx((shape.gradient_at(points) * step).sum(axis=1), abs=2e-6)


def test_a_ball_that_has_grown_is_a_larger_ball():
    points = np.random.default_rng(1).normal(scale=20.0, size=(300, 3))
    assert Grown(ball(np.ones(3), 10.0), 3.0).at(points) == pytest.approx(ball(np.ones(3), 13.0).at(points), abs=1e-5)


def test_rotation_keeps_lengths_and_turns_by_its_angle():
    product = TURN @ TURN.T
    assert product == pytest.approx(np.eye(3), abs=1e-12)
    assert np.trace(TURN) == pytest.approx(1.0 + 2.0 * np.cos(np.deg2rad(25.0)))
