import numpy as np
import pytest

from palpate.phantoms.motion import AffineMotion, filling_of, smooth_field
from palpate.phantoms.shapes import Tube, rotation_about

TUBE = Tube(np.linspace([0.0, 0.0, -20.0], [0.0, 4.0, 20.0], 5), np.full(5, 11.0))


def filling(stray_mm=0.0):
    stray = smooth_field(np.random.default_rng(1), sd_mm=stray_mm, correlation_mm=20.0, features=100)
    return filling_of(
        TUBE,
        filling_mm=7.0,
        fullest_mm=3.0,
        length_mm=18.0,
        towards=np.array([0.0, 1.0, 0.0]),
        lean=0.3,
        stray=stray,
    )


def wall(n=4000):
    directions = np.random.default_rng(2).normal(size=(n, 3))
    return TUBE.surface(directions / np.linalg.norm(directions, axis=1, keepdims=True))


def test_wall_moves_outwards_and_at_its_fullest_by_the_filling():
    points = wall()
    displacement = filling().at(points)
    _, spoke = TUBE.coordinates(points)
    assert np.linalg.norm(displacement, axis=1).max() == pytest.approx(7.0, rel=0.05)
    assert ((displacement * spoke).sum(axis=1) > 0.0).all()


def test_wall_motion_is_smooth_even_where_the_rounded_ends_begin():
    points = wall()
    tangent = np.cross(TUBE.gradient_at(points), [0.3, 0.5, 0.8])
    step = 0.01 * tangent / np.linalg.norm(tangent, axis=1, keepdims=True)
    change = np.linalg.norm(filling(0.35).at(points + step) - filling(0.35).at(points), axis=1) / 0.01
    assert change.max() < 1.2  # filling over radius, and the profile's slope


def test_rigid_motion_keeps_distances():
    motion = AffineMotion(rotation_about(np.array([1.0, 1.0, 0.0]), 2.0) - np.eye(3), np.ones(3), np.array([1.0, 0, 0]))
    points = np.random.default_rng(3).normal(scale=15.0, size=(50, 3))
    moved = points + motion.at(points)
    assert np.linalg.norm(moved - moved[0], axis=1) == pytest.approx(np.linalg.norm(points - points[0], axis=1))


def test_a_field_of_waves_is_their_sum_to_a_millionth_however_far_away():
    field = smooth_field(np.random.default_rng(4), sd_mm=1.0, correlation_mm=10.0, features=300)
    points = np.random.default_rng(5).normal(scale=300.0, size=(1000, 3))
    phase = points @ field.frequencies.T
    assert field.at(points) == pytest.approx(np.cos(phase) @ field.cosines + np.sin(phase) @ field.sines, abs=5e-6)
