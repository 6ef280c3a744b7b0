"""Both optimisers on objectives whose minimum is known by hand."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import OptimizeResult

from palpate.inversion.optimise import (
    FIRST_RADIUS,
    MAX_RADIUS,
    Bounds,
    Outcome,
    ShareOfValue,
    gauss_newton,
    lbfgs,
    same_minimum,
)

WIDE = Bounds(np.full(2, -5.0), np.full(2, 5.0))
METHODS = {"gauss-newton": gauss_newton, "lbfgs": lbfgs}


@pytest.fixture(params=sorted(METHODS))
def minimise(request):
    return METHODS[request.param]


def constrained(quadratic, held):
    """Minimum of a quadratic whose first unknown is held at a value."""
    rest = quadratic.curvature[1:, 1:]
    pull = quadratic.curvature[1:, 0] * (held - quadratic.centre[0])
    return np.concatenate([[held], quadratic.centre[1:] - np.linalg.solve(rest, pull)])


def test_the_minimum_of_a_quadratic_is_found(minimise, toys, rng):
    objective = toys.coupled(rng)
    found = minimise(objective, np.full(5, 2.0), bounds=WIDE, tolerance=1e-10)
    assert found.outcome is Outcome.CONVERGED
    assert found.unknowns == pytest.approx(objective.centre, abs=1e-4)


def test_an_unknown_stops_at_its_bound_and_the_others_go_on(minimise, toys, rng):
    objective = toys.coupled(rng, centre=np.array([3.0, 0.2, -0.1, 0.4, 0.0]))
    bounds = Bounds(np.array([-1.0, -1.0]), np.array([1.0, 1.0]))
    found = minimise(objective, np.zeros(5), bounds=bounds, tolerance=1e-10)
    expected = constrained(objective, 1.0)
    assert np.all(np.abs(expected[1:2]) < 1.0)
    assert found.outcome.converged
    assert found.unknowns == pytest.approx(expected, abs=1e-4)


@pytest.mark.parametrize("start", [-3.0, 3.0])
def test_a_saturating_objective_is_followed_from_both_sides(minimise, toys, start):
    objective = toys.Saturating(np.array([0.3, -0.5]))
    found = minimise(objective, np.full(2, start), bounds=WIDE, tolerance=1e-12)
    assert found.outcome.converged
    assert found.unknowns == pytest.approx(objective.truth, abs=1e-3)


def test_no_step_of_the_log_moduli_is_longer_than_the_radius(toys):
    objective = toys.Saturating(np.array([3.0, 3.0]))
    found = gauss_newton(objective, np.full(2, -4.0), bounds=WIDE)
    thetas = np.stack([iterate.theta for iterate in found.history])
    steps = np.abs(np.diff(thetas, axis=0)).max(axis=1)
    assert 0.3 * FIRST_RADIUS < steps[0] < 1.02 * FIRST_RADIUS
    assert steps.max() < 1.02 * MAX_RADIUS


def test_values_fall_along_the_history(toys, rng):
    found = gauss_newton(toys.Saturating(rng.normal(size=2)), np.full(2, 3.0), bounds=WIDE)
    assert np.all(np.diff([iterate.value for iterate in found.history]) < 0.0)


def test_held_log_moduli_do_not_move(toys, rng):
    objective = toys.coupled(rng)
    start = np.array([0.7, -0.7, 0.0, 0.0, 0.0])
    found = gauss_newton(objective, start, bounds=WIDE, held=True, tolerance=1e-12)
    assert np.array_equal(found.unknowns[:2], start[:2])
    free = objective.curvature[2:, 2:]
    pull = objective.curvature[2:, :2] @ (start[:2] - objective.centre[:2])
    assert found.unknowns[2:] == pytest.approx(objective.centre[2:] - np.linalg.solve(free, pull), abs=1e-6)


def test_too_few_steps_are_not_called_convergence(toys):
    found = gauss_newton(toys.Saturating(np.array([3.0, 3.0])), np.full(2, -4.0), bounds=WIDE, max_steps=2)
    assert found.outcome is Outcome.STEPS
    assert not found.outcome.converged


def test_steps_that_circle_in_the_noise_end_where_the_decrement_was_least(toys):
    found = gauss_newton(toys.Circling(), np.zeros(3), bounds=WIDE, tolerance=1e-9)
    assert found.outcome is Outcome.STALLED
    assert found.evaluations < 10
    assert found.evaluation.score[2] == 0.09


def test_a_rough_minimum_leaves_walls_sliding_but_no_log_modulus_off(toys):
    objective = toys.Sliding(np.array([0.3, -0.5]))
    start = np.concatenate([[2.0, -3.0], np.zeros(objective.slides)])
    rough = gauss_newton(objective, start, bounds=WIDE, tolerance=None)
    exact = gauss_newton(objective, start, bounds=WIDE)
    assert rough.outcome is exact.outcome is Outcome.CONVERGED
    assert rough.evaluations < 0.5 * exact.evaluations
    assert rough.history[-1].decrement < 0.02 * objective.slides < rough.history[-2].decrement
    assert rough.unknowns[:2] == pytest.approx(objective.centre, abs=0.1)  # of a standard deviation of 1
    near_only = np.concatenate([objective.centre + 0.15, np.full(objective.slides, 1.5)])
    assert gauss_newton(objective, near_only, bounds=WIDE, tolerance=None).evaluations > 1


def test_a_share_of_the_value_is_left_where_that_is_noise(toys):
    """What no step takes away is the noise; an iteration that may leave a share of it ends earlier, and is as large."""
    objective = toys.Saturating(np.array([3.0, 3.0]), noise=50.0)
    start = np.full(2, -2.0)
    exact, rough = (
        gauss_newton(objective, start, bounds=WIDE, tolerance=tolerance) for tolerance in (1e-3, ShareOfValue(0.1))
    )
    assert rough.outcome is exact.outcome is Outcome.CONVERGED
    assert rough.evaluations < exact.evaluations
    last, before = rough.history[-1], rough.history[-2]
    assert last.decrement < 0.1 * last.value
    assert before.decrement > 0.1 * before.value
    assert 1.0 <= rough.evaluation.value / exact.evaluation.value < 1.1


def test_no_share_of_the_value_is_the_noise_while_the_drivers_are_at_rest(toys):
    objective = toys.Sliding(np.array([0.3, -0.5]))
    begin = np.concatenate([objective.centre, np.zeros(objective.slides)])
    found = gauss_newton(objective, begin, bounds=WIDE, tolerance=ShareOfValue(1e9))
    assert found.outcome is Outcome.CONVERGED
    assert found.evaluations == 2
    assert gauss_newton(objective, found.unknowns, bounds=WIDE, tolerance=ShareOfValue(1e9)).evaluations == 1


def test_a_start_ends_where_it_meets_the_minimum_of_another_but_not_on_its_way_past_one(toys):
    objective = toys.Saturating(np.array([0.3, -0.5]))
    first = gauss_newton(objective, np.full(2, -3.0), bounds=WIDE, tolerance=1e-12)
    alone = gauss_newton(objective, np.full(2, 3.0), bounds=WIDE, tolerance=1e-12)
    met = gauss_newton(objective, np.full(2, 3.0), bounds=WIDE, tolerance=1e-12, known=[first])
    assert met.outcome is Outcome.JOINED
    assert met.converged
    assert met.evaluations < alone.evaluations
    assert same_minimum(met.unknowns, first, 2)
    on_the_way = replace(first, unknowns=alone.history[2].theta)
    past = gauss_newton(objective, np.full(2, 3.0), bounds=WIDE, tolerance=1e-12, known=[on_the_way])
    assert past.outcome is alone.outcome
    assert past.evaluations == alone.evaluations


@pytest.mark.parametrize(("widths", "outcome"), [(0.2, Outcome.STALLED), (0.5, Outcome.STUCK)])
def test_an_objective_that_no_step_reduces_is_stuck_but_where_a_step_means_nothing(toys, rng, widths, outcome):
    """In posterior widths: what the images hardly know is not lost to the roughness of its objective."""
    sd, direction = np.array([5.0, 3.0, 1.0, 1.0, 1.0]), rng.standard_normal(5)
    wrong = toys.Quadratic(np.diag(sd**-2.0), np.zeros(5), pull=-1.0)
    found = gauss_newton(wrong, widths * sd * direction / np.linalg.norm(direction), bounds=WIDE)
    assert found.outcome is outcome
    assert found.converged is outcome.converged


def test_a_step_to_where_nothing_can_be_solved_is_refused_and_a_shorter_one_taken(toys):
    """The first one overshoots the minimum at 1, as far as 1.15."""
    truth, start = np.ones(2), np.array([1.0, 0.5])
    folds = toys.Folding(toys.Saturating(truth), most=1.05)
    assert gauss_newton(folds.of, start, bounds=WIDE, max_steps=2).history[1].theta[1] > folds.most
    found = gauss_newton(folds, start, bounds=WIDE, tolerance=1e-9)
    assert found.converged
    assert found.unknowns == pytest.approx(truth, abs=1e-4)


def test_where_every_step_leads_to_what_cannot_be_solved_the_outcome_says_so(toys):
    nowhere = toys.Folding(toys.Quadratic(np.eye(3), np.array([0.0, 0.0, 2.0])), most=0.25)
    ended = gauss_newton(nowhere, np.array([0.0, 0.0, 0.25]), bounds=WIDE)
    assert ended.outcome is Outcome.UNSOLVABLE
    assert not ended.converged
    assert "inside out" in ended.outcome.value


def test_an_objective_that_is_no_number_says_so(toys):
    broken = toys.Quadratic(np.full((3, 3), np.nan), np.zeros(3))
    assert gauss_newton(broken, np.ones(3), bounds=WIDE).outcome is Outcome.NOT_FINITE


def test_a_step_that_a_bound_cuts_short_is_judged_by_what_is_left_of_it(toys):
    """A billionth of the way to the minimum is left: the whole step promises a hundred million times as much."""
    objective = toys.Quadratic(np.eye(3), np.array([2.0, 0.1, 0.0]))
    bounds = Bounds(np.full(2, -5.0), np.array([1e-9, 5.0]))
    found = gauss_newton(objective, np.array([0.0, 0.1, 0.0]), bounds=bounds)
    assert found.outcome is Outcome.CONVERGED
    assert found.unknowns[0] == 1e-9
    assert found.evaluations == 2


def test_a_step_that_a_bound_bends_uphill_is_not_taken(toys):
    """The step leads out of the bound, though the slope there leads in: what is left of it promises a larger value."""
    objective = toys.Quadratic(np.array([[1.0, 0.95], [0.95, 1.0]]), np.array([0.5, -0.5]), height=1e-6)
    bounds = Bounds(np.full(2, -5.0), np.array([0.0, 5.0]))
    found = gauss_newton(objective, np.array([0.0, 0.2]), bounds=bounds, tolerance=1e-8)
    values = [iterate.value for iterate in found.history]
    assert np.all(np.diff(values) <= 0.0)
    assert found.outcome.converged
    assert found.unknowns == pytest.approx([0.0, -0.025], abs=1e-3)


def test_what_lbfgs_is_told_of_a_place_does_not_depend_on_what_it_asked_before(toys, rng, monkeypatch):
    """The places are so near each other that the coefficients of one would pass for those of the other."""
    objective, start = toys.coupled(rng), np.zeros(5)
    places = {"a": np.array([2.0, -2.0]), "b": np.array([2.05, -2.0])}

    def told(order):
        found = {}

        def ask(value_and_slope, first, **_options):
            found.update({name: value_and_slope(places[name]) for name in order})
            return OptimizeResult(x=first, success=True)

        monkeypatch.setattr("palpate.inversion.optimise.optimize.minimize", ask)
        lbfgs(objective, start, bounds=WIDE, tolerance=1e-2)
        return {name: (value, slope.tolist()) for name, (value, slope) in found.items()}

    assert told("ab") == told("ba") == told("abba")


def test_the_start_is_not_written_into(minimise, toys, rng):
    start = np.full(5, 0.5)
    minimise(toys.coupled(rng), start, bounds=WIDE)
    assert np.array_equal(start, np.full(5, 0.5))
