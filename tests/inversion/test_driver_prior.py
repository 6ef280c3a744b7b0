"""The prior of a driver's motion, learned from what its wall shows."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from palpate.inversion.driver_prior import learned_prior
from palpate.observation.wall_modes import Wall, wall_modes

N_MODES = 90


def wall(*, prior_mm=5.0, kernel_mm=20.0):
    points = np.random.default_rng(0).normal(size=(400, 3))
    points *= 30.0 / np.linalg.norm(points, axis=1, keepdims=True)
    modes = wall_modes(points, n_modes=N_MODES, kernel_mm=kernel_mm, prior_mm=prior_mm)
    return Wall(points, points / 30.0, np.arange(modes.shape[1]), modes[::3, ::3], kernel_mm, prior_mm)


def learned(wall, motion, *, sd_mm, axis=0):
    """Prior covariance (n_points, n_points) mm^2 of a component, after a motion (n_points, 3) mm was seen."""
    modes = np.kron(wall.scalar, np.eye(3))
    precision = learned_precision(wall, motion, sd_mm=sd_mm)
    return modes[axis::3] @ np.linalg.solve(precision, modes[axis::3].T)


def learned_precision(wall, motion, *, sd_mm, seen=None):
    """Prior precision (n_modes, n_modes), all of the motion or its part along the unit vectors `seen` shown."""
    modes = np.kron(wall.scalar, np.eye(3))
    if seen is not None:
        rows = modes.reshape(len(seen), 3, -1)
        modes, motion = np.einsum("pa,pam->pm", seen, rows), np.einsum("pa,pa->p", seen, motion)
    data = modes.T @ modes / sd_mm**2
    score = -modes.T @ motion.ravel() / sd_mm**2  # at no motion
    prior = np.eye(len(data))
    evaluation = SimpleNamespace(matrix=data + prior, prior=prior, score=score)
    problem = SimpleNamespace(
        walls=((wall,),), models=(SimpleNamespace(n_modes=len(data)),), modulus_map=SimpleNamespace(tissues=())
    )
    return learned_prior(problem, evaluation, np.zeros(len(data)))


def drawn(wall, *, sd_mm, kernel_mm, seed):
    distance2 = np.sum((wall.points[:, None] - wall.points[None]) ** 2, axis=2)
    covariance = np.exp(-distance2 / (2.0 * kernel_mm**2)) + 1e-9 * np.eye(len(distance2))
    return sd_mm * np.linalg.cholesky(covariance) @ np.random.default_rng(seed).normal(size=(len(distance2), 3))


@pytest.mark.parametrize("sd_mm", [0.4, 2.0, 8.0])
def test_the_amplitude_is_that_of_the_motion(sd_mm):
    here = wall()
    found = [
        np.sqrt(learned(here, drawn(here, sd_mm=sd_mm, kernel_mm=20.0, seed=seed), sd_mm=0.05).diagonal().mean())
        for seed in range(6)
    ]
    assert np.exp(np.mean(np.log(found))) == pytest.approx(sd_mm, rel=0.2)


def test_a_wall_that_moves_as_one_may_not_slide_in_parts():
    here = wall()
    gradient = np.array([[0.06, 0.02, 0.0], [0.02, -0.09, 0.01], [0.0, 0.01, 0.03]])
    stiff = learned(here, here.points @ gradient, sd_mm=0.05)
    rough = learned(here, drawn(here, sd_mm=1.5, kernel_mm=20.0, seed=1), sd_mm=0.05)
    near = np.linalg.norm(here.points[0] - here.points, axis=1).argsort()[60]
    correlation = [c[0, near] / np.sqrt(c[0, 0] * c[near, near]) for c in (stiff, rough)]
    assert correlation[0] > 0.9 > correlation[1] + 0.1


def expected_sliding(wall, motion):
    """Mean tangential motion, mm, that the prior expects of a wall whose normal motion alone was seen."""
    precision = learned_precision(wall, motion, sd_mm=0.05, seen=wall.normals)
    modes = np.kron(wall.scalar, np.eye(3))
    normal = np.einsum("pa,pam->pm", wall.normals, modes.reshape(len(wall.normals), 3, -1))
    shown = np.einsum("pa,pa->p", wall.normals, motion)
    q = np.linalg.solve(normal.T @ normal / 0.05**2 + precision, normal.T @ shown / 0.05**2)
    moved = (modes @ q).reshape(-1, 3)
    along = np.einsum("pa,pa->p", wall.normals, moved)
    return float(np.linalg.norm(moved - along[:, None] * wall.normals, axis=1).mean())


def test_a_wall_that_swells_is_not_taken_for_one_that_slides():
    here = wall()
    waves = 3.0 * (1.0 + 0.6 * np.cos(here.points @ np.array([0.03, 0.04, 0.02])))
    assert expected_sliding(here, waves[:, None] * here.normals) < 0.3


def test_a_wall_that_shifts_as_one_is_not_taken_for_one_that_swells():
    here = wall()
    shift = np.tile([2.0, -1.0, 0.5], (len(here.points), 1))
    across = shift - np.einsum("pa,pa->p", here.normals, shift)[:, None] * here.normals
    assert expected_sliding(here, shift) == pytest.approx(np.linalg.norm(across, axis=1).mean(), rel=0.1)


def test_the_first_guess_of_the_amplitude_does_not_matter():
    motion = drawn(wall(), sd_mm=2.0, kernel_mm=25.0, seed=3)
    first, second = (learned(wall(prior_mm=prior), motion, sd_mm=0.2) for prior in (4.0, 8.0))
    assert second == pytest.approx(first, rel=0.05, abs=0.02 * np.abs(first).max())


def test_what_is_not_seen_at_all_keeps_a_bounded_prior():
    here = wall()
    variance = learned(here, np.zeros_like(here.points), sd_mm=1e6).diagonal()
    assert np.all(variance > 0.0)
    assert np.all(np.isfinite(variance))
    assert variance.max() < 2.0 * (2.0 * 5.0 * 1.1) ** 2


def test_walls_that_are_not_given_keep_the_modes_own_prior():
    assert learned_prior(SimpleNamespace(walls=()), None, np.zeros(3)) is None
