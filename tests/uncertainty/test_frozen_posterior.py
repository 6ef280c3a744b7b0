"""The frozen posterior is the objective near by."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from palpate.errors import ConfigurationError
from palpate.inversion import Bounds, MarginalPosterior, fixed_correspondence, frozen_posterior, gauss_newton, pulls_of
from palpate.mechanics.finite_strain import finite_strain_model
from palpate.mechanics.first_order import expanded
from palpate.mechanics.laws.registry import law_named
from palpate.observation.noise_model import NoiseModel

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
    assert frozen(place).value == pytest.approx(evaluation.value, rel=1e-9)
    for _ in range(3):
        step = 1e-4 * rng.standard_normal(len(minimum))
        slope = 0.5 * (frozen(place + step).value - frozen(place - step).value)
        assert slope == pytest.approx(float(evaluation.score @ step), rel=1e-4, abs=1e-9)


def test_in_the_driver_the_frozen_posterior_is_the_quadratic_of_gauss_newton(objective, minimum, rng):
    frozen, evaluation = frozen_posterior(objective, minimum), objective(minimum)
    step = np.concatenate([np.zeros(2), 0.1 * rng.standard_normal(len(minimum) - 2)])
    expected = evaluation.value + evaluation.score @ step + 0.5 * step @ (evaluation.matrix @ step)
    assert frozen(minimum + step).value == pytest.approx(expected, rel=1e-9)


def test_score_and_matrix_of_the_frozen_posterior_are_those_of_all_residuals_far_away(objective, minimum, rng):
    evaluation, away = objective(minimum), minimum + 0.3 * rng.standard_normal(len(minimum))
    frozen = frozen_posterior(objective, minimum, evaluation)(away)
    fixed = fixed_correspondence(objective, minimum, evaluation)(away)
    assert frozen.score == pytest.approx(fixed.score, rel=1e-8, abs=1e-8 * np.abs(fixed.score).max())
    assert frozen.matrix.dense == pytest.approx(fixed.matrix.dense, rel=1e-8, abs=1e-8 * fixed.matrix.diagonal.max())


def test_changed_residuals_pull_as_if_the_posterior_were_frozen_with_them(objective, minimum, rng):
    evaluation, away = objective(minimum), minimum + 0.2 * rng.standard_normal(len(minimum))
    frozen = frozen_posterior(objective, minimum, evaluation)
    changes = [[0.1 * rng.standard_normal(len(of.weights)) for of in evaluation.linearisations] for _ in range(2)]
    for pulls, errors in zip(pulls_of(objective, minimum, evaluation, changes), changes, strict=True):
        terms = zip(evaluation.linearisations, errors, strict=True)
        other = replace(evaluation, linearisations=tuple(of.with_errors(0.5 * error) for of, error in terms))
        expected, found = frozen_posterior(objective, minimum, other)(away), frozen.pulled(pulls, 0.5)(away)
        assert found.score == pytest.approx(expected.score, rel=1e-8, abs=1e-8 * np.abs(expected.score).max())
        assert np.array_equal(found.matrix.dense, frozen(away).matrix.dense)


def test_at_held_moduli_the_place_where_m_is_seen_is_the_minimum_of_all_else(objective, minimum):
    frozen = frozen_posterior(objective, minimum)
    start = minimum + np.concatenate([[0.4, -0.3], np.full(len(minimum) - 2, 0.1)])
    held = Bounds(start[:2], start[:2])
    expected = gauss_newton(frozen, start, bounds=held, tolerance=1e-12)
    found = MarginalPosterior.of(frozen).minimum(start, held)
    room = 0.5 * np.linalg.slogdet(expected.evaluation.matrix.dense[2:, 2:])[1]
    assert found.minimum.converged
    assert found.minimum.unknowns == pytest.approx(expected.unknowns, abs=1e-6)
    assert found.least == pytest.approx(expected.evaluation.value + room, rel=1e-8)


def test_a_full_model_is_refused(objective, minimum, twin):
    states = (replace(objective.states[0], observed=twin.model),)
    with pytest.raises(ConfigurationError, match="LinearModel"):
        frozen_posterior(replace(objective, states=states), minimum)


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
    assert frozen(away).value == pytest.approx(fixed(away).value, rel=1e-9)
    assert frozen(unknowns).value == pytest.approx(fixed(unknowns).value, rel=1e-9)
    assert frozen(away).score == pytest.approx(fixed(away).score, rel=1e-8, abs=1e-8)
    assert frozen(away).matrix.dense == pytest.approx(fixed(away).matrix.dense, rel=1e-8, abs=1e-8)
