"""What two moduli are known to be together, where each alone is not."""

from __future__ import annotations

import numpy as np
import pytest

from palpate.uncertainty.combinations import information, known_pairs

THETA = np.log([6.0, 3.0])
NAMES = ("prostate", "bladder")


def of(sd_ratio, sd_mean):
    """Covariance with given standard deviations of ln (E_1 / E_2) and of its mean."""
    basis = np.array([[1.0, -1.0], [0.5, 0.5]])
    inverse = np.linalg.inv(basis)
    return inverse @ np.diag([sd_ratio**2, sd_mean**2]) @ inverse.T


def test_a_ratio_is_known_where_both_moduli_go_up_and_down_together():
    (found,) = known_pairs(NAMES, THETA, of(0.05, 0.8), within=2.0)
    assert (found.tissues, found.kind, found.value) == (NAMES, "ratio", pytest.approx(2.0))
    assert found.interval95 == pytest.approx((2.0 * np.exp(-0.098), 2.0 * np.exp(0.098)), rel=1e-3)


def test_a_product_is_known_where_one_makes_up_for_the_other():
    (found,) = known_pairs(NAMES, THETA, of(1.2, 0.05), within=2.0)
    assert (found.kind, found.value) == ("geometric mean", pytest.approx(np.sqrt(18.0)))


@pytest.mark.parametrize("covariance", [of(0.8, 0.8), of(0.05, 0.05)], ids=["neither is known", "each is known"])
def test_nothing_is_said_where_nothing_is_gained(covariance):
    assert known_pairs(NAMES, THETA, covariance, within=2.0) == ()


def test_the_best_known_direction_comes_first_and_all_of_them_make_up_the_covariance():
    covariance = of(0.05, 0.8)
    found = information(covariance)
    assert np.all(np.diff(found.singular_values) < 0.0)
    again = found.directions.T @ np.diag(found.singular_values**-2.0) @ found.directions
    assert again == pytest.approx(covariance)
    assert found.directions[0][0] * found.directions[0][1] < 0.0
