"""Tukey's biweight with a part that is spared, and Huber's loss."""

from __future__ import annotations

import numpy as np
import pytest

from palpate.observation.robust_loss import HUBER, Huber, Tukey


@pytest.mark.parametrize("loss", [Tukey(), Tukey(0.7), Tukey(0.7, 0.4), Huber(0.4)])
def test_the_slope_is_that_of_the_square_times_the_weight(loss):
    residuals, step = np.linspace(-1.5, 1.5, 601) + 1e-4, 1e-6
    slope = (loss.rho(residuals + step) - loss.rho(residuals - step)) / (2.0 * step)
    assert slope == pytest.approx(2.0 * residuals * loss.weight(residuals), abs=1e-8)


def test_it_is_the_square_up_to_what_is_spared_and_level_beyond_the_cutoff():
    loss = Tukey(0.7, 0.4)
    inside = np.linspace(-0.4, 0.4, 41)
    assert loss.rho(inside) == pytest.approx(inside**2, abs=1e-15)
    assert loss.weight(inside).tolist() == [1.0] * 41
    far = np.array([-5.0, -1.1001, 1.1001, 5.0])
    assert not loss.weight(far).any()
    assert np.ptp(loss.rho(far)) < 1e-15


def test_nothing_spared_is_the_biweight():
    residuals = np.linspace(-1.0, 1.0, 21)
    inside = np.maximum(1.0 - (residuals / 0.7) ** 2, 0.0)
    assert Tukey(0.7).rho(residuals) == pytest.approx(0.7**2 / 3.0 * (1.0 - inside**3))


def test_no_residual_is_ever_without_pull_under_hubers():
    loss = Huber(0.4)
    pulls = [float(r * loss.weight(np.array([r]))[0]) for r in (0.2, 0.4, 4.0, 400.0)]
    assert pulls == pytest.approx([0.2, 0.4, 0.4, 0.4])


@pytest.mark.parametrize("loss", [Tukey(4.685 * 0.3), Huber(HUBER * 0.3)])
def test_a_mean_square_is_the_variance_of_normal_residuals_whatever_a_few_outliers_say(loss):
    """Of 10 000 residuals 100 lie at 30 standard deviations: their plain mean square is ten times the variance."""
    residuals = np.random.default_rng(0).normal(0.0, 0.3, 10_000)
    assert loss.mean_square(residuals, np.ones(10_000)) == pytest.approx(0.3**2, rel=0.03)
    residuals[:100] = 9.0
    assert np.mean(residuals**2) > 9.0 * 0.3**2
    assert loss.mean_square(residuals, np.ones(10_000)) < 1.6 * 0.3**2
