"""Sampling the posterior: the frozen form is the objective near by, and its chain has the law it should."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from scipy import stats

from palpate.errors import ConfigurationError
from palpate.inversion import Bounds, fixed_correspondence, frozen_posterior, gauss_newton
from palpate.mechanics.finite_strain import finite_strain_model
from palpate.mechanics.first_order import expanded
from palpate.mechanics.laws.registry import law_named
from palpate.observation.noise_model import NoiseModel
from palpate.uncertainty.sampling import posterior_chains

WIDE = Bounds(np.full(2, np.log(0.02)), np.full(2, np.log(200.0)))
NOISE = NoiseModel(np.array([0.05**2]), np.array([3.0]))


@pytest.fixture(scope="module", params=["flat", "normal"])
def objective(request, twins, twin):
    """With a flat prior of the log-moduli, and with a normal one."""
    found = twins.objective_of(twins.exact_problem(twin, noise=NOISE), twin.coefficients).rematched(twin.unknowns)
    if request.param == "flat":
        return found
    return replace(found, parameters=found.parameters.with_prior(twins.TRUTH + 0.02, np.full(2, 0.02)))


@pytest.fixture(scope="module")
def minimum(objective, twin):
    return gauss_newton(objective, twin.unknowns, bounds=WIDE).unknowns


def test_the_frozen_posterior_has_the_value_and_score_of_the_objective_where_it_is_frozen(objective, minimum, rng):
    place = minimum + 0.05 * rng.standard_normal(len(minimum))
    frozen, evaluation = frozen_posterior(objective, place), objective(place)
    assert frozen.value(place) == pytest.approx(evaluation.value, rel=1e-9)
    for _ in range(3):
        step = 1e-4 * rng.standard_normal(len(minimum))
        slope = 0.5 * (frozen.value(place + step) - frozen.value(place - step))
        assert slope == pytest.approx(float(evaluation.score @ step), rel=1e-4, abs=1e-9)


def test_in_the_driver_the_frozen_posterior_is_the_quadratic_of_gauss_newton(objective, minimum, rng):
    frozen, evaluation = frozen_posterior(objective, minimum), objective(minimum)
    step = np.concatenate([np.zeros(2), 0.1 * rng.standard_normal(len(minimum) - 2)])
    expected = evaluation.value + evaluation.score @ step + 0.5 * step @ evaluation.matrix @ step
    assert frozen.value(minimum + step) == pytest.approx(expected, rel=1e-9)


def test_a_full_model_is_refused(objective, minimum, twin):
    states = (replace(objective.states[0], observed=twin.model),)
    with pytest.raises(ConfigurationError, match="LinearModel"):
        frozen_posterior(replace(objective, states=states), minimum)


def test_chains_have_the_covariance_that_is_asked_and_agree_with_each_other(objective, minimum, rng):
    evaluation, wanted = objective(minimum), np.array([[4e-4, 1e-4], [1e-4, 9e-4]])
    frozen = frozen_posterior(objective, minimum, evaluation)
    given = {"bounds": WIDE, "chains": 4, "draws": 500, "rng": rng}
    found = posterior_chains(frozen, minimum, evaluation, wanted, **given)
    theta = found.theta
    assert theta.shape == (4, 500, 2)
    together = theta.reshape(-1, 2)
    assert together.mean(axis=0) == pytest.approx(minimum[:2], abs=0.004)
    assert np.cov(together.T) == pytest.approx(wanted, rel=0.3, abs=5e-5)
    within, between = theta.std(axis=1).mean(axis=0), theta.mean(axis=1).std(axis=0)
    assert np.all(between < 0.25 * within)
    assert np.all((found.accepted > 0.5) & (found.accepted <= 1.0))
    below = -objective(minimum).value - found.log_density  # half of chi-squared with as many degrees as unknowns
    assert below.shape == (4, 500)
    assert below.mean() == pytest.approx(0.5 * len(minimum), rel=0.15)


def test_no_draw_of_a_chain_leaves_the_bounds_and_they_cut_the_density_that_is_asked(objective, minimum):
    """That of a normal law between them, which a draw that is stretched beyond them, or cut before, is none of."""
    evaluation, wanted = objective(minimum), np.diag([0.05**2, 0.02**2])
    frozen, upper = frozen_posterior(objective, minimum, evaluation), minimum[:2] + np.array([0.05, 1.0])
    given = {"bounds": Bounds(WIDE.lower, upper), "chains": 4, "draws": 800, "rng": np.random.default_rng(2)}
    theta = posterior_chains(frozen, minimum, evaluation, wanted, **given).theta[..., 0].ravel()
    assert theta.max() <= upper[0]
    law = stats.truncnorm(-np.inf, 1.0, loc=minimum[0], scale=0.05)
    levels = np.array([0.1, 0.5, 0.9])
    assert law.cdf(np.quantile(theta, levels)) == pytest.approx(levels, abs=0.06)


def test_every_chain_moves_where_a_part_of_the_unknowns_is_impossible(objective, minimum):
    """A start there, from where hardly a proposal leads back, would be all that its chain ever tells."""
    evaluation, frozen = objective(minimum), frozen_posterior(objective, minimum)
    own = np.linalg.inv(evaluation.matrix)[:2, :2]
    furthest = minimum[0] + 0.3 * np.sqrt(own[0, 0])
    cut = SimpleNamespace(objective=objective, value=lambda x: np.inf if x[0] > furthest else frozen.value(x))
    given = {"bounds": WIDE, "chains": 8, "draws": 20, "rng": np.random.default_rng(1)}
    found = posterior_chains(cut, minimum, evaluation, own, **given)
    assert found.accepted.min() > 0.1
    assert found.theta[..., 0].max() <= furthest


def test_chains_of_several_blocks_have_the_covariance_of_laplace_and_the_same_draws_with_a_seed(objective, minimum):
    evaluation = objective(minimum)
    frozen = frozen_posterior(objective, minimum, evaluation)
    own = np.linalg.inv(evaluation.matrix)[:2, :2]
    given = {"bounds": WIDE, "chains": 1, "draws": 600}  # 6600 steps, of which a block has 4000
    first, second = (
        posterior_chains(frozen, minimum, evaluation, own, rng=np.random.default_rng(3), **given) for _ in range(2)
    )
    assert first.theta.shape == (1, 600, 2)
    assert np.array_equal(first.theta, second.theta)
    assert np.std(first.theta, axis=(0, 1)) == pytest.approx(np.sqrt(np.diag(own)), rel=0.25)


def test_an_expansion_that_bends_is_frozen_with_its_own_value_far_away(twins, rng):
    """As the objective with the same closest points has it, residual by residual."""
    twin = twins.make_twin(element="P1", seed=8)
    problem, law = twins.exact_problem(twin, noise=NOISE), law_named("neo-hookean")
    plain = twins.objective_of(problem, twin.coefficients)
    moduli, q = twin.moduli, 0.5 * twin.coefficients
    there = finite_strain_model(twin.model.space, twin.model.constraint, law).solve(moduli, q)
    first = expanded(there, names=twin.model.names, moduli=moduli, coefficients=q)
    (state,) = plain.states
    bent = replace(plain, states=(replace(state, observed=first.outputs(state.seen), bending=state.approximation),))
    unknowns = np.concatenate([twins.TRUTH, q])
    bent = bent.rematched(unknowns)
    evaluation = bent(unknowns)
    frozen, fixed = frozen_posterior(bent, unknowns, evaluation), fixed_correspondence(bent, unknowns, evaluation)
    away = unknowns + 0.5 * rng.standard_normal(len(unknowns))
    assert frozen.value(away) == pytest.approx(fixed(away).value, rel=1e-9)
    assert frozen.value(unknowns) == pytest.approx(fixed(unknowns).value, rel=1e-9)
