"""What is left of a posterior: its minimum, its width and its bounds, where all of it is known in closed form."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import pytest
from scipy import optimize

from palpate.inversion import Bounds, Evaluation, MarginalPosterior
from palpate.unknowns import Arrowhead

WIDE = Bounds(np.full(2, -6.0), np.full(2, 6.0))
NOTHING = np.zeros(0, dtype=np.int64)


@dataclass(frozen=True)
class Valley:
    """J = 1/2 |r|^2 of residuals (theta - centre) / sd along turned axes, and e_k (y_k - g_k . theta) of others y.

    e_k = exp(share_k . theta / 2): the room of y is 1/2 sum_k share_k . theta, or, where it `levels`, its tanh.
    """

    centre: np.ndarray
    root: np.ndarray
    shares: np.ndarray
    follows: np.ndarray
    levels: float = np.inf
    n_parameters: int = 2

    def exponent(self, theta):
        whole = self.shares @ theta
        return whole if np.isinf(self.levels) else self.levels * np.tanh(whole / self.levels)

    def left(self, theta):
        """M in closed form."""
        r = self.root @ (theta - self.centre)
        return 0.5 * r @ r + 0.5 * self.exponent(theta).sum()

    def __call__(self, x):
        theta, y = x[:2], x[2:]
        e = np.exp(0.5 * self.exponent(theta))
        away = y - self.follows @ theta
        bends = (
            self.shares
            if np.isinf(self.levels)
            else (self.shares * (1.0 - np.tanh(self.shares @ theta / self.levels) ** 2)[:, None])
        )
        r = np.concatenate([self.root @ (theta - self.centre), e * away])
        by_theta = np.concatenate([self.root, e[:, None] * (0.5 * bends * away[:, None] - self.follows)])
        slopes = np.column_stack([by_theta, np.concatenate([np.zeros((2, len(y))), np.diag(e)])])
        matrix = Arrowhead.of(slopes.T @ slopes)
        nothing = Arrowhead.zeros(matrix.places)
        return Evaluation(0.5 * float(r @ r), 0.0, slopes.T @ r, matrix, (), nothing, np.zeros(len(x)))


def valley(rng, n=12, *, pull=1.0, levels=np.inf, correlation=0.0):
    covariance = 0.1 * np.array([[1.0, correlation], [correlation, 1.0]])
    root = np.linalg.cholesky(np.linalg.inv(covariance)).T
    shares = pull * rng.standard_normal((n, 2)) + 0.3 * pull
    return Valley(np.array([0.4, -0.2]), root, shares, rng.standard_normal((n, 2)), levels)


def bends(of, at, step=1e-3):
    """Second derivatives of a function by differences."""
    unit = step * np.eye(2)
    return np.array(
        [
            [(of(at + a + b) - of(at + a - b) - of(at - a + b) + of(at - a - b)) / 4 / step**2 for b in unit]
            for a in unit
        ]
    )


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("correlation", [0.0, 0.95])
@pytest.mark.parametrize("start", [(0.0, 0.0), (2.0, -2.0)])
def test_the_minimum_and_the_width_are_those_of_the_closed_form(seed, correlation, start):
    """The room bends, by up to as much as J does: from near by and from far away."""
    of = valley(np.random.default_rng(seed), pull=2.0, levels=1.5, correlation=correlation)
    found = MarginalPosterior(of, NOTHING).minimum(np.concatenate([start, np.zeros(12)]), WIDE)
    truth = min((optimize.minimize(of.left, place) for place in (start, of.centre)), key=lambda each: each.fun)
    sd = np.sqrt(np.diag(found.covariance))
    assert found.minimum.converged
    assert np.all(np.abs(found.minimum.unknowns[:2] - truth.x) < 0.1 * sd)
    assert found.minimum.unknowns[2:] == pytest.approx(of.follows @ found.minimum.unknowns[:2], abs=1e-6)
    assert found.least == pytest.approx(truth.fun, abs=0.01)
    along = np.linalg.eigvalsh(np.linalg.solve(np.linalg.inv(bends(of.left, truth.x)), found.covariance))
    assert np.all(np.abs(np.log(along)) < 0.4)


def test_where_the_room_is_straight_it_is_exact(rng):
    of = valley(rng, correlation=0.6)
    found = MarginalPosterior(of, NOTHING).minimum(np.zeros(14), WIDE)
    covariance = np.linalg.inv(of.root.T @ of.root)
    assert found.covariance == pytest.approx(covariance, rel=1e-6)
    assert found.minimum.unknowns[:2] == pytest.approx(of.centre - covariance @ of.shares.sum(axis=0) / 2.0, abs=1e-6)
    assert found.volume.slope == pytest.approx(of.shares.sum(axis=0) / 2.0, rel=1e-6)
    value = of.left(found.minimum.unknowns[:2]) - 0.5 * np.linalg.slogdet(covariance)[1]
    assert found.value == pytest.approx(value, abs=1e-6)


def test_a_bound_holds_one_and_the_other_follows(rng):
    of = valley(rng, correlation=0.9)
    free = MarginalPosterior(of, NOTHING).minimum(np.zeros(14), WIDE).minimum.unknowns[:2]
    bound = Bounds(WIDE.lower, np.array([free[0] - 0.3, 6.0]))
    found = MarginalPosterior(of, NOTHING).minimum(np.zeros(14), bound).minimum
    best = optimize.minimize_scalar(lambda second: of.left(np.array([bound.upper[0], second])))
    assert found.converged
    assert found.unknowns[0] == bound.upper[0]
    assert found.unknowns[1] == pytest.approx(best.x, abs=0.01)


def test_what_is_held_stays_and_has_no_width(rng):
    of = valley(rng, correlation=0.9)
    held = Bounds(np.array([0.7, -6.0]), np.array([0.7, 6.0]))
    found = MarginalPosterior(of, NOTHING).minimum(np.zeros(14), held)
    assert found.minimum.unknowns[0] == 0.7
    assert np.isinf(found.covariance[0, 0])
    assert found.covariance[1, 1] == pytest.approx(1.0 / (of.root.T @ of.root)[1, 1], rel=1e-6)


def test_a_modulus_that_moves_nothing_is_left_where_it_is(rng):
    of = valley(rng)
    root, shares = of.root.copy(), of.shares.copy()
    root[:, 1], shares[:, 1] = 0.0, 0.0
    of = replace(of, root=root, shares=shares, follows=of.follows * [1.0, 0.0])
    found = MarginalPosterior(of, NOTHING).minimum(np.append([0.0, 0.5], np.zeros(12)), WIDE)
    assert found.minimum.unknowns[1] == 0.5
    assert np.isinf(found.covariance[1, 1])
    assert np.isfinite(found.covariance[0, 0])
