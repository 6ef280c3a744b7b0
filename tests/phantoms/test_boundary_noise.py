import numpy as np
import pytest

from palpate.phantoms.motion import smooth_field


def pairs(distance, n=4000):
    rng = np.random.default_rng(1)
    points = rng.uniform(-200.0, 200.0, (n, 3))
    direction = rng.normal(size=(n, 3))
    return points, points + distance * direction / np.linalg.norm(direction, axis=1, keepdims=True)


def test_each_component_has_the_stated_spread():
    field = smooth_field(np.random.default_rng(2), sd_mm=0.3, correlation_mm=6.0)
    assert field.at(pairs(0.0)[0]).std(axis=0) == pytest.approx(0.3, rel=0.06)


@pytest.mark.parametrize("distance", [3.0, 6.0, 12.0])
def test_correlation_falls_as_a_squared_exponential(distance):
    field = smooth_field(np.random.default_rng(3), sd_mm=0.3, correlation_mm=6.0)
    here, there = (field.at(points) for points in pairs(distance))
    correlation = (here * there).mean() / (here**2).mean()
    assert correlation == pytest.approx(np.exp(-(distance**2) / 72.0), abs=0.04)


def test_components_and_draws_are_independent():
    rng = np.random.default_rng(4)
    first, second = (smooth_field(rng, sd_mm=1.0, correlation_mm=6.0).at(pairs(0.0)[0]) for _ in range(2))
    correlation = np.corrcoef(np.concatenate([first, second], axis=1), rowvar=False)
    assert np.abs(correlation - np.eye(6)).max() < 0.08


def test_the_same_seed_gives_the_same_field():
    points = pairs(0.0, 10)[0]
    fields = [smooth_field(np.random.default_rng(5), sd_mm=0.3, correlation_mm=6.0) for _ in range(2)]
    assert np.array_equal(fields[0].warp(points), points + fields[1].at(points))
