"""The posterior of theta is what is left when all other unknowns are integrated out: by quadrature, of small bodies."""

from __future__ import annotations

from dataclasses import dataclass, replace
from types import SimpleNamespace

import numpy as np
import pytest

from palpate.inversion import (
    Bounds,
    InverseProblem,
    InversionSettings,
    LaterState,
    Objective,
    cheapest_posterior,
    gauss_newton,
    invert,
    mixture_of,
)
from palpate.progress import silent
from palpate.unknowns import Acts, Alternative, Block, Choice, ParameterMap, unit_blocks
from palpate.unknowns.parameters import LEVELS_OFF, Volume

SD = 0.1  # of a reading
WIDE = Bounds(np.full(1, -4.0), np.full(1, 4.0))
THETA = np.linspace(-0.8, 2.5, 166)


@dataclass(frozen=True)
class Yielding:
    """Outputs u = a ln E + E^-1 M q: what is soft follows its boundary q further; a (n,), M (n, m)."""

    slopes: np.ndarray
    modes: np.ndarray

    n_regions = 1

    @property
    def n_modes(self):
        return self.modes.shape[1]

    @property
    def constraint(self):
        return SimpleNamespace(n_modes=self.n_modes)

    def outputs(self, seen):
        return replace(self, slopes=seen(self.slopes), modes=seen(self.modes))

    def solve(self, moduli, coefficients):
        theta, follows = np.log(moduli[0]), self.modes / moduli[0]
        moved = follows @ coefficients
        tangent = np.column_stack([self.slopes - moved, follows])
        return SimpleNamespace(values=self.slopes * theta + moved, tangent=tangent.copy)


def yielding(rng, blocks=None, *, pulls=0.1, shares=0.3):
    """One modulus that readings hardly tell, two modes that they tell as well as it is soft; what was read of 0.3."""
    body = Yielding(pulls * rng.standard_normal(9), shares * rng.standard_normal((9, 2)))
    parameters = ParameterMap(np.ones(1), np.ones((1, 1)), ("gland",), "rest", True, blocks or unit_blocks(2))
    return body, parameters, body.slopes * 0.3


def objective_of(patients, body, parameters, seen):
    state = LaterState(body, (patients.readings("gland", np.arange(len(seen)), seen),))
    return Objective((state.with_approximation(patients.Whole(body)),), parameters)


def mixture_at(objective, bounds=WIDE, **named):
    at = np.zeros(objective.parameters.n_unknowns)
    evaluation = objective(at)
    return mixture_of(cheapest_posterior(objective, at, evaluation), at, evaluation, bounds, **named)


def integrated(body, seen, sds):
    """Ln of the integral of exp(-J) over q at every theta, on a grid of q; J's least value over that grid."""
    line = np.linspace(-4.0, 4.0, 121)
    q = np.stack(np.meshgrid(*(sd * line for sd in sds), indexing="ij"), axis=-1).reshape(-1, 2)
    cell = np.prod(np.asarray(sds) * (line[1] - line[0]))
    prior = 0.5 * np.sum((q / sds) ** 2, axis=1) + np.log(2.0 * np.pi * np.prod(sds))
    found, least = [], []
    for theta in THETA:
        away = body.slopes * theta + np.exp(-theta) * q @ body.modes.T - seen
        values = 0.5 * np.sum(away**2, axis=1) / SD**2 + prior
        least.append(values.min())
        found.append(np.log(cell * np.sum(np.exp(values.min() - values))) - values.min())
    return np.array(found), np.array(least)


def spread(levels):
    """Mean and standard deviation of theta with densities exp(levels) on its grid."""
    weights = np.exp(levels - levels.max())
    mean = weights @ THETA / weights.sum()
    return mean, np.sqrt(weights @ (THETA - mean) ** 2 / weights.sum())


@pytest.mark.parametrize("seed", range(4))
def test_theta_is_where_the_integral_over_all_else_is_largest_and_not_where_j_is_least(patients, seed):
    body, parameters, seen = yielding(np.random.default_rng(seed))
    objective = objective_of(patients, body, parameters, seen)
    (found,) = mixture_at(objective).explanations
    levels, least = integrated(body, seen, np.ones(2))
    _, sd = spread(levels)
    mode, together = (THETA[np.argmax(of)] for of in (levels, -least))
    assert abs(together - mode) > 0.4 * sd
    assert abs(found.theta[0] - mode) < 0.1 * sd
    joint = gauss_newton(objective, np.zeros(3), bounds=WIDE).unknowns[0]
    assert joint == pytest.approx(together, abs=0.05 * sd)


def test_so_it_is_at_the_end_of_a_search(patients):
    body, parameters, seen = yielding(np.random.default_rng(4))
    problem = objective_of(patients, body, parameters, seen)
    settings = InversionSettings((np.zeros(1),), WIDE)
    found = invert(InverseProblem(problem.states, parameters), settings, progress=silent)
    levels, _ = integrated(body, seen, np.ones(2))
    assert found.mixture.mean[0] == pytest.approx(THETA[np.argmax(levels)], abs=0.1 * spread(levels)[1])


@pytest.mark.parametrize("seed", range(3))
def test_level_and_width_are_those_of_the_integral_over_all_else(patients, seed):
    """Where the room is not 0, and bends: the Gauss-Newton matrix has neither."""
    body, parameters, seen = yielding(np.random.default_rng(seed), pulls=0.05)
    (found,) = mixture_at(objective_of(patients, body, parameters, seen)).explanations
    levels, _ = integrated(body, seen, np.ones(2))
    top = int(np.argmax(levels))
    step = THETA[1] - THETA[0]
    bend = -(levels[top + 1] + levels[top - 1] - 2.0 * levels[top]) / step**2
    assert found.covariance[0, 0] == pytest.approx(1.0 / bend, rel=0.1)
    assert found.level == pytest.approx(levels[top] - 0.5 * np.log(bend), abs=0.05)
    assert abs(found.volume.slope[0]) > 0.1


def test_an_explanation_weighs_as_much_as_its_integral_over_all_unknowns(patients):
    """Modes that move much, or little: the ratio of both integrals; Laplace's approximation misses a tenth of it."""
    levels = tuple(Alternative(sd**2 * np.eye(2), 0.0, name) for sd, name in ((0.3, "still"), (1.0, "moves")))
    block = Block("frame", "frame", Acts.BOUNDARY, (0,), levels, Choice.FRAME)
    body, parameters, seen = yielding(np.random.default_rng(2), (block,))
    found = {of.chosen[0]: of for of in mixture_at(objective_of(patients, body, parameters, seen)).explanations}
    totals = [np.log(np.sum(np.exp(integrated(body, seen, np.full(2, sd))[0]))) for sd in (0.3, 1.0)]
    assert abs(totals[1] - totals[0]) > 1.0
    assert found[1].level - found[0].level == pytest.approx(totals[1] - totals[0], abs=0.1)


@pytest.mark.parametrize("wide", [10.0, 30.0, 100.0])
def test_a_modulus_that_an_explanation_leaves_open_counts_no_more_than_its_bounds_leave(patients, wide):
    """Readings a (theta + q): by quadrature over theta between its bounds, a normal law being as wide as they are."""
    levels = tuple(Alternative(np.full((1, 1), sd**2), 0.0, name) for sd, name in ((1e-3, "still"), (wide, "moves")))
    block = Block("frame", "frame", Acts.BOUNDARY, (0,), levels, Choice.FRAME)
    a, seen = np.full(9, 1.0), np.full(9, 0.5)
    slopes = np.column_stack([a, a])
    body = patients.Response(slopes, np.zeros((9, 1)), 1)
    parameters = ParameterMap(np.ones(1), np.ones((1, 1)), ("gland",), "rest", True, (block,))
    objective = objective_of(patients, body, parameters, seen)
    found = {of.chosen[0]: of for of in mixture_at(objective).explanations}
    between = 8.0 / (np.sqrt(2.0 * np.pi) * wide)  # of the integral where q stands still
    as_wide = np.sqrt(2.0 * np.pi / 12.0)  # of a normal law with the variance of an even one, over that one
    assert found[1].level - found[0].level == pytest.approx(np.log(between * as_wide), abs=0.1)


def test_room_levels_off_where_theta_hardly_matters():
    """Its slope at the place is g, its values stay within 1.5 g of those there, and derivatives are its slopes."""
    room = Volume(np.array([-2.0, 0.7]), np.array([0.3, -0.4]))
    value, slope = room.at(room.centre)
    assert value == 0.0
    assert slope == pytest.approx(room.slope)
    for far in (-20.0, 20.0):
        value, slope = room.at(room.centre + np.array([far, -far]))
        assert value == pytest.approx(np.sign(far) * LEVELS_OFF * (-2.0 - 0.7))
        assert np.abs(slope).max() < 1e-9
    theta, h = np.array([1.1, -1.6]), 1e-6
    steps = h * np.eye(2)
    differences = [(room.at(theta + s)[0] - room.at(theta - s)[0]) / (2.0 * h) for s in steps]
    assert room.at(theta)[1] == pytest.approx(differences, rel=1e-6)
    assert np.all(np.abs(room.at(theta)[1]) < np.abs(room.slope))
