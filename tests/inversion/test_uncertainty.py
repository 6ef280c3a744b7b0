"""The sandwich is the covariance that repeated experiments show, correlated residuals and driver included."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
from palpate.inversion.cramer_rao import cramer_rao, efficient_gain
from palpate.inversion.noise import NoiseLaw
from palpate.inversion.posterior import gain, sandwich_covariance
from palpate.observation.misfit import SurfaceResiduals

from palpate.inversion.objective import Evaluation, Linearisation
from palpate.phantoms.boundary_noise import smooth_field

SD = 0.3


def sphere(n, radius):
    k = np.arange(n) + 0.5
    height, turn = 1.0 - 2.0 * k / n, np.pi * (1.0 + np.sqrt(5.0)) * k
    flat = np.sqrt(1.0 - height**2)
    normals = np.column_stack([flat * np.cos(turn), flat * np.sin(turn), height])
    return radius * normals, normals


def surface(places, normals, jacobian, *, precision, state=0, rest="a"):
    n = len(places)
    weights = np.full(n, 1.0 / n)
    residuals = SurfaceResiduals(np.zeros(n), weights, places, normals, places, np.zeros(n), None, None)
    columns, target = np.arange(jacobian.shape[1]), SimpleNamespace(area=np.ones(n), surface=rest)
    return Linearisation(residuals, columns, jacobian, weights, precision, target, None, state)


def evaluation(surfaces, n_parameters):
    """The evaluation of surfaces with a prior of unit variance on all unknowns after the first ones."""
    n = surfaces[0].jacobian.shape[1]
    prior = np.diag(np.where(np.arange(n) < n_parameters, 0.0, 1.0))
    matrix = prior.copy()
    for line in surfaces:
        matrix += line.precision * line.jacobian.T @ (line.weights[:, None] * line.jacobian)
    return Evaluation(0.0, 0.0, np.zeros(n), np.zeros(n), matrix, tuple(surfaces), prior)


@pytest.fixture
def smooth():
    """A smooth Jacobian on a sphere: two log-moduli, then three modes."""
    places, normals = sphere(600, 15.0)
    x, y, z = normals.T
    jacobian = np.column_stack([0.3 * x * y, 0.3 * z, 0.4 * z + 0.2 * x, 0.5 * y, 0.3 * (z**2 - x**2)])
    return places, normals, jacobian


def test_independent_residuals_give_the_usual_formula(rng):
    places = 10.0 * np.stack(np.meshgrid(*[np.arange(5.0)] * 3), axis=-1).reshape(-1, 3)
    normals = np.tile([[0.0, 0.0, 1.0]], (len(places), 1))
    jacobian = rng.standard_normal((len(places), 4))
    now = evaluation([surface(places, normals, jacobian, precision=len(places) / SD**2)], 2)
    law = NoiseLaw(np.array([SD**2]), np.array([0.5]))
    assert sandwich_covariance(now, law, 2) == pytest.approx(np.linalg.inv(now.matrix)[:2, :2], rel=1e-9)


def test_the_gain_moves_the_estimate_as_a_normal_equation_does(smooth, rng):
    places, normals, jacobian = smooth
    now = evaluation([surface(places, normals, jacobian, precision=50.0)], 2)
    errors = rng.standard_normal(len(places))
    expected = np.linalg.solve(now.matrix, 50.0 / len(places) * jacobian.T @ errors)[:2]
    assert gain(now, 2)[0] @ errors == pytest.approx(expected, rel=1e-9)


def test_the_interval_covers_the_truth_of_repeated_experiments(smooth, rng):
    places, normals, jacobian = smooth
    now = evaluation([surface(places, normals, jacobian, precision=200.0)], 2)
    covariance = sandwich_covariance(now, NoiseLaw(np.array([SD**2]), np.array([5.0])), 2)
    draws = []
    for _ in range(400):
        field = smooth_field(rng, sd_mm=SD, correlation_mm=5.0, features=200)
        error = np.einsum("na,na->n", field.at(places), normals)
        prior = np.concatenate([np.zeros(2), rng.standard_normal(3)])
        score = prior - 200.0 / len(places) * jacobian.T @ error
        draws.append(-np.linalg.solve(now.matrix, score)[:2])
    spread = np.cov(np.transpose(draws))
    assert np.sqrt(np.diag(covariance)) == pytest.approx(np.sqrt(np.diag(spread)), rel=0.12)
    inside = np.abs(draws) < 1.96 * np.sqrt(np.diag(covariance))
    assert np.all((inside.mean(axis=0) > 0.92) & (inside.mean(axis=0) < 0.98))


def test_correlated_residuals_tell_less(smooth):
    places, normals, jacobian = smooth
    now = evaluation([surface(places, normals, jacobian, precision=200.0)], 2)
    short, long = (
        sandwich_covariance(now, NoiseLaw(np.array([SD**2]), np.array([length])), 2) for length in (0.8, 6.0)
    )
    assert np.all(np.diag(long) > 1.5 * np.diag(short))


def twice(smooth, *, sign, rests):
    """Two later states, the second with `sign` times the motion of the first, with modes of their own."""
    places, normals, jacobian = smooth
    modes, none = jacobian[:, 2:], np.zeros((len(places), 3))
    first = np.hstack([jacobian[:, :2], modes, none])
    second = np.hstack([sign * jacobian[:, :2], none, modes])
    pairs = enumerate(zip((first, second), rests, strict=True))
    return evaluation(
        [surface(places, normals, rows, precision=200.0, state=i, rest=rest) for i, (rows, rest) in pairs], 2
    )


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_a_second_pair_of_images_halves_the_variance(smooth, sign):
    law = NoiseLaw(np.array([SD**2]), np.array([5.0]))
    one = sandwich_covariance(evaluation([surface(*smooth, precision=200.0)], 2), law, 2)
    two = sandwich_covariance(twice(smooth, sign=sign, rests="ab"), law, 2)
    assert two == pytest.approx(0.5 * one, rel=1e-6)


def test_the_noise_of_a_shared_rest_state_is_not_averaged_away_by_a_like_motion_but_cancels_in_an_opposite_one(smooth):
    law = NoiseLaw(np.array([SD**2]), np.array([5.0]))
    pairs = sandwich_covariance(twice(smooth, sign=1.0, rests="ab"), law, 2)
    alike = sandwich_covariance(twice(smooth, sign=1.0, rests="aa"), law, 2)
    opposite = sandwich_covariance(twice(smooth, sign=-1.0, rests="aa"), law, 2)
    assert np.all(np.diag(alike) > 1.2 * np.diag(pairs))
    assert np.all(np.diag(opposite) < 0.8 * np.diag(pairs))


@pytest.fixture
def observed(smooth):
    """An evaluation on the smooth surface, and noise that is smooth over 5 mm."""
    return evaluation([surface(*smooth, precision=200.0)], 2), NoiseLaw(np.array([SD**2]), np.array([5.0]))


def test_no_estimate_beats_the_cramer_rao_limit(observed):
    now, law = observed
    limit = cramer_rao(now, law, 2, cell_mm=5.0)
    assert np.linalg.eigvalsh(sandwich_covariance(now, law, 2) - 0.95 * limit).min() > 0.0
    assert np.linalg.eigvalsh(limit).min() > 0.0


def test_the_weights_of_the_limit_attain_it_under_noise_of_its_law(observed, rng):
    now, law = observed
    places, normals = now.surfaces[0].residuals.places, now.surfaces[0].residuals.normals
    rows, *_ = efficient_gain(now, law, 2, cell_mm=5.0)
    kept = np.eye(5)[:2] - rows @ now.surfaces[0].jacobian  # what is not seen of the unknowns comes from their prior
    assert kept[:, :2] == pytest.approx(np.zeros((2, 2)), abs=1e-9)  # no bias in the log-moduli
    draws = [
        rows @ np.einsum("na,na->n", smooth_field(rng, sd_mm=SD, correlation_mm=5.0, features=200).at(places), normals)
        for _ in range(400)
    ]
    found = np.cov(np.transpose(draws)) + kept[:, 2:] @ np.linalg.solve(now.prior[2:, 2:], kept[:, 2:].T)
    limit = cramer_rao(now, law, 2, cell_mm=5.0)
    assert np.sqrt(np.diag(found)) == pytest.approx(np.sqrt(np.diag(limit)), rel=0.12)


def test_cells_of_the_noises_length_lose_little(observed):
    now, law = observed
    fine, cells = (np.sqrt(np.diag(cramer_rao(now, law, 2, cell_mm=size))) for size in (2.0, 5.0))
    assert np.all(cells >= fine * (1.0 - 1e-9))
    assert np.all(cells < 1.1 * fine)


def test_roughness_of_single_faces_hardly_lowers_the_limit_of_cells(smooth, observed, rng):
    """A derivative that is rough from face to face seems to tell the moduli from what smooth noise leaves alone.

    Of cells with five faces each the limit falls by 6 %, of single faces to a fifteenth.
    """
    places, normals, jacobian = smooth
    rough = jacobian * (1.0 + 0.05 * rng.standard_normal((len(places), 1)))
    now, law = evaluation([surface(places, normals, rough, precision=200.0)], 2), observed[1]
    single, cells, smooth_limit = (
        np.sqrt(np.diag(cramer_rao(of, law, 2, cell_mm=size)))
        for of, size in ((now, 0.1), (now, 5.0), (observed[0], 5.0))
    )
    assert np.all(cells > 0.8 * smooth_limit)
    assert np.all(single < 0.4 * smooth_limit)
