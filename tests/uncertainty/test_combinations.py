"""What two moduli are known to be together, where each alone is not."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import pytest

from palpate.inversion import Bounds, Evaluation, MarginalPosterior, gauss_newton
from palpate.uncertainty.combinations import information, known_pairs
from palpate.unknowns import Arrowhead

THETA = np.log([6.0, 3.0])
WIDE = Bounds(np.full(2, np.log(0.02)), np.full(2, np.log(200.0)))
NAMES = ("prostate", "bladder")


def of(sd_ratio, sd_mean):
    """Covariance with given standard deviations of ln (E_1 / E_2) and of its mean."""
    basis = np.array([[1.0, -1.0], [0.5, 0.5]])
    inverse = np.linalg.inv(basis)
    return inverse @ np.diag([sd_ratio**2, sd_mean**2]) @ inverse.T


@dataclass(frozen=True)
class Toy:
    """1/2 |r|^2 of residuals r(theta) (n,) of two log-moduli, with their derivatives (n, 2)."""

    residuals: Callable
    derivatives: Callable
    n_parameters: int = 2

    def __call__(self, theta):
        r, slopes = self.residuals(theta), self.derivatives(theta)
        pull, matrix = slopes.T @ r, Arrowhead.of(slopes.T @ slopes)
        return Evaluation(0.5 * float(r @ r), 0.0, pull, matrix, (), Arrowhead.zeros(matrix.places), np.zeros(2))


def parabola(covariance):
    root = np.linalg.cholesky(np.linalg.inv(covariance)).T
    return Toy(lambda theta: root @ (theta - THETA), lambda _: root)


def known(problem, covariance, within=2.0, start=THETA):
    minimum = gauss_newton(problem, start, bounds=WIDE, tolerance=1e-10)
    marginal = MarginalPosterior(problem, np.zeros(0, dtype=np.int64))
    return known_pairs(marginal, minimum, NAMES, covariance, bounds=WIDE, within=within)


def test_a_ratio_is_known_where_both_moduli_go_up_and_down_together():
    (found,) = known(parabola(of(0.05, 0.8)), of(0.05, 0.8))
    assert (found.tissues, found.kind, found.value) == (NAMES, "ratio", pytest.approx(2.0))
    assert found.interval95 == pytest.approx((2.0 * np.exp(-0.098), 2.0 * np.exp(0.098)), rel=1e-3)


def test_a_product_is_known_where_one_makes_up_for_the_other():
    (found,) = known(parabola(of(1.2, 0.05)), of(1.2, 0.05))
    assert (found.kind, found.value) == ("geometric mean", pytest.approx(np.sqrt(18.0)))


def test_a_ratio_that_is_known_where_the_estimate_lies_is_not_known_if_it_is_open_for_stiffer_moduli():
    """Two moduli that matter less the stiffer they are: by the ellipse their ratio is known within a factor of 1.5."""
    slope, middle = np.array([0.5, 0.5]) / 1.5, np.log([3.0, 3.0])

    def residuals(theta):
        return np.array([np.exp(-theta) @ [1.0, -1.0] / 0.03, slope @ (theta - middle)])

    def derivatives(theta):
        return np.array([np.exp(-theta) * [-1.0, 1.0] / 0.03, slope])

    bent, there = Toy(residuals, derivatives), derivatives(middle)
    straight = Toy(lambda theta: there @ (theta - middle), lambda _: there)
    covariance = np.linalg.inv(there.T @ there)
    (found,) = known(straight, covariance, start=middle)
    assert found.kind == "ratio"
    assert found.interval95[1] / found.interval95[0] < 1.5
    assert known(bent, covariance, within=4.0, start=middle) == ()
    (wide,) = known(bent, covariance, within=20.0, start=middle)
    assert wide.interval95[1] / wide.interval95[0] > 4.0


@pytest.mark.parametrize("covariance", [of(0.8, 0.8), of(0.05, 0.05)], ids=["neither is known", "each is known"])
def test_nothing_is_said_where_nothing_is_gained(covariance):
    assert known(parabola(covariance), covariance) == ()


def test_the_best_known_direction_comes_first_and_all_of_them_make_up_the_covariance():
    covariance = of(0.05, 0.8)
    found = information(covariance)
    assert np.all(np.diff(found.singular_values) < 0.0)
    again = found.directions.T @ np.diag(found.singular_values**-2.0) @ found.directions
    assert again == pytest.approx(covariance)
    assert found.directions[0][0] * found.directions[0][1] < 0.0
