"""The profile of a modulus: an ellipse where the model is straight, the posterior's own lean where it bends."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import pytest

from palpate.inversion import Bounds, MarginalPosterior, fixed_correspondence, gauss_newton
from palpate.mechanics.curved import CurvedModel
from palpate.mechanics.finite_strain import finite_strain_model
from palpate.mechanics.first_order import expanded
from palpate.mechanics.laws.registry import law_named
from palpate.uncertainty import NORMAL_95
from palpate.uncertainty.profile import profile

WIDE = Bounds(np.full(2, np.log(0.02)), np.full(2, np.log(200.0)))


@pytest.fixture(scope="module")
def variance(minimum):
    return np.diag(minimum.evaluation.covariance_columns(2))


def profiled(objective, minimum, number, variance, bounds=WIDE):
    fixed = MarginalPosterior.of(fixed_correspondence(objective, minimum.unknowns, minimum.evaluation))
    return profile(fixed, minimum, number, variance=variance, bounds=bounds, level=NORMAL_95)


def test_where_the_model_is_straight_the_ends_are_those_of_the_ellipse(objective, minimum, variance, straight):
    for number in range(2):
        found = profiled(straight(objective, minimum), minimum, number, variance[number])
        half = NORMAL_95 * np.sqrt(variance[number])
        centre = minimum.unknowns[number]
        assert (found.low, found.high) == pytest.approx((centre - half, centre + half), abs=0.02 * half)
        assert np.all(np.diff(found.theta) > 0.0)
        assert np.all(np.diff(found.root) > 0.0)


def test_at_the_ends_what_is_left_of_the_posterior_is_lower_by_the_level(objective, minimum, variance):
    """J at its best over all that is not held, and the room of all but the moduli."""
    fixed = fixed_correspondence(objective, minimum.unknowns, minimum.evaluation)
    least = MarginalPosterior.of(fixed).minimum(minimum.unknowns, WIDE)
    scale = least.covariance[0, 0] / variance[0]
    found = profiled(objective, minimum, 0, variance[0])
    for end in (found.low, found.high):

        def left(other, end=end, least=least):
            theta = np.array([end, other])
            start = np.concatenate([theta, least.minimum.unknowns[2:]])
            best = gauss_newton(fixed, start, bounds=Bounds(theta, theta), tolerance=1e-10).evaluation
            return best.value + 0.5 * np.linalg.slogdet(best.matrix.dense[2:, 2:])[1]

        near = least.minimum.unknowns[1] + np.linspace(-1.5, 1.5, 41)
        assert 2.0 * scale * (min(map(left, near)) - least.least) == pytest.approx(NORMAL_95**2, rel=0.05)


def test_a_wider_variance_widens_the_interval(objective, minimum, variance):
    narrow, wide = (profiled(objective, minimum, 0, share * variance[0]) for share in (1.0, 1.5))
    assert wide.low < narrow.low < narrow.high < wide.high


def marginals(fixed, minimum, variance, number):
    """Quantiles of one log-modulus by its posterior on a grid, all other unknowns integrated over by Laplace."""
    half, n = 4.0 * np.sqrt(variance), len(variance)
    axes = [np.linspace(-1.0, 1.0, 33) * h + c for h, c in zip(half, minimum.unknowns, strict=False)]
    density = np.empty((33, 33))
    for i, first in enumerate(axes[0]):
        for j, second in enumerate(axes[1]):
            start = np.concatenate([[first, second], minimum.unknowns[n:]])
            there = Bounds(start[:n], start[:n])
            best = gauss_newton(fixed, start, bounds=there, tolerance=1e-6).evaluation
            density[i, j] = -best.value - 0.5 * np.linalg.slogdet(best.matrix.dense[n:, n:])[1]
    one = np.exp(density - density.max()).sum(axis=1 - number)
    below = np.concatenate([[0.0], np.cumsum(0.5 * (one[1:] + one[:-1]))])
    return np.interp([0.025, 0.975], below / below[-1], axes[number])


def test_it_leans_as_the_posterior_does(objective, minimum, variance):
    fixed = fixed_correspondence(objective, minimum.unknowns, minimum.evaluation)
    for number in range(2):
        found, centre = profiled(objective, minimum, number, variance[number]), minimum.unknowns[number]
        low, high = marginals(fixed, minimum, variance, number)
        lean = (found.high - centre) / (centre - found.low)
        assert abs(np.log(lean)) > 0.05  # or there would be nothing to show
        assert np.sign(np.log(lean)) == np.sign(np.log((high - centre) / (centre - low)))
        assert (found.low, found.high) == pytest.approx((low, high), abs=0.15 * (found.high - found.low))


@dataclass(frozen=True)
class Restless:
    """Another objective that goes up and down with one of the log-moduli: no parabola leads to a minimum of it."""

    of: object
    number: int

    @property
    def n_parameters(self):
        return self.of.n_parameters

    def __call__(self, unknowns):
        there = self.of(unknowns)
        return replace(there, value=there.value + 1.5 + 1.5 * np.sin(40.0 * unknowns[self.number]))


def test_a_fit_that_does_not_end_makes_no_interval_narrower(objective, minimum, variance):
    """Its deviance is too large, so that the level seems to be reached too soon."""
    whole = MarginalPosterior.of(fixed_correspondence(objective, minimum.unknowns, minimum.evaluation))
    least, nothing = whole.minimum(minimum.unknowns, WIDE).minimum, np.zeros(0, dtype=np.int64)
    for number, centre in enumerate(least.unknowns[:2]):
        given = {"variance": variance[number], "bounds": WIDE, "level": NORMAL_95}
        restless = MarginalPosterior(Restless(whole.objective, 1 - number), nothing)
        ends, found = (profile(of, least, number, **given) for of in (whole, restless))
        assert (found.low, found.high) != (ends.low, ends.high)
        assert found.low is None or centre - found.low > 0.98 * (centre - ends.low)
        assert found.high is None or found.high - centre > 0.98 * (ends.high - centre)


def test_an_end_beyond_the_bounds_is_open(objective, minimum, variance):
    centre, sd = minimum.unknowns[:2], np.sqrt(variance)
    near = Bounds(WIDE.lower, centre + np.array([1.0, 20.0]) * sd)
    found = profiled(objective, minimum, 0, variance[0], bounds=near)
    assert found.high is None
    assert found.theta[-1] == near.upper[0]
    assert found.low is not None


@pytest.fixture(scope="module")
def bodies(twins):
    """The same body under the linear and under the neo-Hookean law, at one place."""
    twin = twins.make_twin(element="P1", seed=8)
    law = finite_strain_model(twin.model.space, twin.model.constraint, law_named("neo-hookean"))
    return twin.model, law, twin.moduli, 0.7 * twin.coefficients


def test_an_expansion_that_bends_is_exact_at_its_place_with_its_derivatives(bodies):
    linear, law, moduli, q = bodies
    expansion = expanded(law.solve(moduli, q), names=linear.names, moduli=moduli, coefficients=q)
    there = CurvedModel.of(expansion, linear).solve(moduli, q)
    assert there.values == pytest.approx(expansion.values, abs=1e-12)
    assert there.tangent() == pytest.approx(expansion.derivatives, abs=1e-9)
    load = np.sin(np.arange(len(there.values)))
    assert there.adjoint(load) == pytest.approx(there.tangent().T @ load, rel=1e-7, abs=1e-9)


@pytest.mark.parametrize("factor", [0.3, 3.0])
def test_it_is_nearer_to_the_law_far_away_than_the_expansion_alone(bodies, factor):
    linear, law, moduli, q = bodies
    expansion = expanded(law.solve(moduli, q), names=linear.names, moduli=moduli, coefficients=q)
    far = moduli * np.array([factor, 1.0, 1.0])
    exact = law.solve(far, q).values
    bent, plain = (of.solve(far, q).values for of in (CurvedModel.of(expansion, linear), expansion))
    assert np.linalg.norm(bent - exact) < 0.6 * np.linalg.norm(plain - exact)
