"""Wall modes: the Karhunen-Loeve basis of a smooth random motion."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.distance import cdist

from palpate.observation.wall_modes import wall_modes

KERNEL, PRIOR = 20.0, 5.0


@pytest.fixture(scope="module")
def tube():
    """A wall of 11 mm radius and 60 mm length."""
    turn, along = np.meshgrid(np.linspace(0.0, 2.0 * np.pi, 20, endpoint=False), np.linspace(-30.0, 30.0, 16))
    return np.column_stack([11.0 * np.cos(turn.ravel()), 11.0 * np.sin(turn.ravel()), along.ravel()])


def modes_of(points, n_modes):
    return wall_modes(points, n_modes=n_modes, kernel_mm=KERNEL, prior_mm=PRIOR)


def kernel(points):
    return PRIOR**2 * np.exp(-(cdist(points, points) ** 2) / (2.0 * KERNEL**2))


def test_the_modes_approximate_the_kernel(tube):
    modes = modes_of(tube, 90)
    error = modes @ modes.T - np.kron(kernel(tube), np.eye(3))
    assert np.abs(error).max() < 0.02 * PRIOR**2


def test_no_other_basis_of_as_many_modes_comes_closer(tube):
    modes = modes_of(tube, 30)[::3, ::3]
    leading = np.sort(np.linalg.eigvalsh(kernel(tube)))[::-1]
    assert np.linalg.norm(modes, axis=0) ** 2 == pytest.approx(leading[:10], rel=1e-3)
    gram = modes.T @ modes
    assert np.abs(gram - np.diag(np.diag(gram))).max() < 1e-9 * gram.max()


def test_more_modes_explain_more_and_never_more_than_the_prior(tube):
    variances = [np.sum(modes_of(tube, n) ** 2, axis=1) for n in (9, 30, 90)]
    assert np.all(variances[0] <= variances[1] + 1e-9)
    assert np.all(variances[1] <= variances[2] + 1e-9)
    assert variances[2].max() <= PRIOR**2 * (1.0 + 1e-9)


def test_a_translation_is_among_the_motions(tube):
    modes = modes_of(tube, 90)
    for axis in range(3):
        shift = np.kron(np.ones(len(tube)), np.eye(3)[axis])
        coefficients = np.linalg.lstsq(modes, shift, rcond=None)[0]
        assert np.abs(modes @ coefficients - shift).max() < 0.02
        assert np.linalg.norm(coefficients) < 1.0  # a motion of 1 mm is likely under a prior of 5 mm


def test_each_mode_moves_along_one_axis(tube):
    parts = modes_of(tube, 30).reshape(len(tube), 3, 30)
    for mode in range(30):
        assert np.flatnonzero(np.any(parts[:, :, mode] != 0.0, axis=0)).tolist() == [mode % 3]


@pytest.mark.parametrize(("wanted", "given"), [(90, 90), (31, 30), (3, 3)])
def test_modes_come_in_threes(tube, wanted, given):
    assert modes_of(tube, wanted).shape == (3 * len(tube), given)


def test_a_small_wall_has_fewer_modes():
    patch = np.random.default_rng(1).uniform(0.0, 1e-3, (40, 3))
    assert modes_of(patch, 90).shape[1] < 30
    pair = np.array([[0.0, 0.0, 0.0], [5.0, 0.0, 0.0]])
    assert modes_of(pair, 90).shape == (6, 6)
