"""Gauss-Newton on objectives whose minimum is known by hand."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from palpate.errors import SolverError
from palpate.inversion.optimise import RADIUS, Bounds, Outcome, TrustRegion, gauss_newton, same_minimum
from palpate.unknowns import Arrowhead

WIDE = Bounds(np.full(2, -5.0), np.full(2, 5.0))


def constrained(quadratic, held):
    """Minimum of a quadratic whose first unknown is held at a value."""
    rest = quadratic.curvature[1:, 1:]
    pull = quadratic.curvature[1:, 0] * (held - quadratic.centre[0])
    return np.concatenate([[held], quadratic.centre[1:] - np.linalg.solve(rest, pull)])


def test_the_minimum_of_a_quadratic_is_found(toys, rng):
    objective = toys.coupled(rng)
    found = gauss_newton(objective, np.full(5, 2.0), bounds=WIDE, tolerance=1e-10)
    assert found.outcome is Outcome.CONVERGED
    assert found.unknowns == pytest.approx(objective.centre, abs=1e-4)


def test_an_unknown_stops_at_its_bound_and_the_others_go_on(toys, rng):
    objective = toys.coupled(rng, centre=np.array([3.0, 0.2, -0.1, 0.4, 0.0]))
    bounds = Bounds(np.array([-1.0, -1.0]), np.array([1.0, 1.0]))
    found = gauss_newton(objective, np.zeros(5), bounds=bounds, tolerance=1e-10)
    expected = constrained(objective, 1.0)
    assert np.all(np.abs(expected[1:2]) < 1.0)
    assert found.outcome.converged
    assert found.unknowns == pytest.approx(expected, abs=1e-4)


@pytest.mark.parametrize("start", [-3.0, 3.0])
def test_a_saturating_objective_is_followed_from_both_sides(toys, start):
    objective = toys.Saturating(np.array([0.3, -0.5]))
    found = gauss_newton(objective, np.full(2, start), bounds=WIDE, tolerance=1e-12)
    assert found.outcome.converged
    assert found.unknowns == pytest.approx(objective.truth, abs=1e-3)


def test_no_step_of_the_log_moduli_is_longer_than_the_radius(toys):
    objective = toys.Saturating(np.array([3.0, 3.0]))
    found = gauss_newton(objective, np.full(2, -4.0), bounds=WIDE)
    thetas = np.stack([iterate.theta for iterate in found.history])
    steps = np.abs(np.diff(thetas, axis=0)).max(axis=1)
    assert 0.15 * RADIUS < steps[0] < 0.51 * RADIUS
    assert steps.max() < 1.02 * RADIUS


def test_values_fall_along_the_history(toys, rng):
    found = gauss_newton(toys.Saturating(rng.normal(size=2)), np.full(2, 3.0), bounds=WIDE)
    assert np.all(np.diff([iterate.value for iterate in found.history]) < 0.0)


def test_held_log_moduli_do_not_move(toys, rng):
    objective = toys.coupled(rng)
    start = np.array([0.7, -0.7, 0.0, 0.0, 0.0])
    found = gauss_newton(objective, start, bounds=Bounds(start[:2], start[:2]), tolerance=1e-12)
    assert np.array_equal(found.unknowns[:2], start[:2])
    free = objective.curvature[2:, 2:]
    pull = objective.curvature[2:, :2] @ (start[:2] - objective.centre[:2])
    assert found.unknowns[2:] == pytest.approx(objective.centre[2:] - np.linalg.solve(free, pull), abs=1e-6)


def test_too_few_steps_are_not_called_convergence(toys):
    found = gauss_newton(toys.Saturating(np.array([3.0, 3.0])), np.full(2, -4.0), bounds=WIDE, max_steps=2)
    assert found.outcome is Outcome.STEPS
    assert not found.outcome.converged


def test_an_objective_that_no_step_reduces_is_stuck(toys, rng):
    sd, direction = np.array([5.0, 3.0, 1.0, 1.0, 1.0]), rng.standard_normal(5)
    wrong = toys.Quadratic(np.diag(sd**-2.0), np.zeros(5), pull=-1.0)
    found = gauss_newton(wrong, 0.5 * sd * direction / np.linalg.norm(direction), bounds=WIDE)
    assert found.outcome is Outcome.STUCK
    assert not found.converged


def test_a_minimum_to_the_tolerance_that_no_step_reduces_is_one(toys, rng):
    """What no step finds lower where it promises less than the tolerance is a minimum whatever `within` asks for."""
    wrong = toys.Quadratic(np.eye(5), np.zeros(5), pull=-1.0)
    found = gauss_newton(wrong, 1e-3 * rng.standard_normal(5), bounds=WIDE, within=1e-9)
    assert found.outcome is Outcome.CONVERGED


def test_minima_within_a_posterior_width_are_one(toys):
    found = gauss_newton(toys.Quadratic(np.diag([4.0, 4.0]), np.zeros(2)), np.ones(2), bounds=WIDE)
    assert same_minimum(found.unknowns + np.array([0.4, -0.4]), found, 2)
    assert not same_minimum(found.unknowns + np.array([0.6, 0.0]), found, 2)


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
    objective = toys.Quadratic(np.array([[1.0, 0.95], [0.95, 1.0]]), np.array([0.5, -0.5]))
    bounds = Bounds(np.full(2, -5.0), np.array([0.0, 5.0]))
    found = gauss_newton(objective, np.array([0.0, 0.2]), bounds=bounds, tolerance=1e-8)
    values = [iterate.value for iterate in found.history]
    assert np.all(np.diff(values) <= 0.0)
    assert found.outcome.converged
    assert found.unknowns == pytest.approx([0.0, -0.025], abs=1e-3)


def test_the_start_is_not_written_into(toys, rng):
    start = np.full(5, 0.5)
    gauss_newton(toys.coupled(rng), start, bounds=WIDE)
    assert np.array_equal(start, np.full(5, 0.5))


def test_a_direction_that_bends_twice_as_much_as_the_matrix_says_is_not_crossed_to_and_fro(toys, rng):
    """The whole step leads as far beyond the minimum; the place between both slopes is the minimum along it."""
    objective = toys.coupled(rng)
    root = np.linalg.cholesky(objective.curvature)
    along = np.array([0.0, 0.0, 0.6, 0.8, 0.0])
    matrix = root @ (np.eye(5) - 0.495 * np.outer(along, along)) @ root.T

    class Bent:
        n_parameters = 2

        def __call__(self, unknowns):
            return replace(objective(unknowns), matrix=Arrowhead.of(matrix))

    found = gauss_newton(Bent(), np.full(5, 2.0), bounds=WIDE, tolerance=1e-9)
    assert found.outcome is Outcome.CONVERGED
    assert len(found.history) < 12
    assert found.unknowns == pytest.approx(objective.centre, abs=1e-3)


def test_a_step_is_taken_whole_where_the_place_between_both_slopes_cannot_be_solved(toys, rng):
    objective = toys.coupled(rng)

    class Hollow:
        n_parameters = 2

        def __call__(self, unknowns):
            there = objective(unknowns)
            if there.value < 1e-9:
                raise SolverError("the motion turns elements inside out")
            return replace(there, matrix=Arrowhead.of(there.matrix.dense / 1.9))

    away = np.array([0.2, -0.3, 0.1, 0.4, -0.2])
    found = gauss_newton(Hollow(), objective.centre + away, bounds=WIDE, max_steps=2)
    assert found.history[1].theta == pytest.approx((objective.centre - 0.9 * away)[:2], abs=1e-9)


def test_a_step_that_other_unknowns_make_too_long_does_not_shorten_those_of_the_log_moduli():
    """It is damped, which passes; a radius would stay as short as the log-moduli's part of it was."""
    refused = TrustRegion().smaller(1e-4)
    assert refused.radius == TrustRegion().radius
    assert refused.damping > 0.0
    assert refused.after(1.0, 1e-4).damping == 0.0
    assert TrustRegion().smaller(0.5).radius == 0.25
    useless = TrustRegion().smaller(0.5, damps=True)
    assert (useless.radius, useless.damping) == (refused.radius, refused.damping)
