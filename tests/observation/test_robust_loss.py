"""Huber's loss and one with a power law's tails: each is minus the logarithm of a density."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.integrate import quad

from palpate.observation.robust_loss import Huber, PowerLaw

LOSSES = [PowerLaw(), PowerLaw(0.7), Huber(0.4)]


@pytest.mark.parametrize("loss", LOSSES)
def test_the_slope_is_that_of_the_square_times_the_weight(loss):
    residuals, step = np.linspace(-1.5, 1.5, 601) + 1e-4, 1e-6
    slope = (loss.rho(residuals + step) - loss.rho(residuals - step)) / (2.0 * step)
    assert slope == pytest.approx(2.0 * residuals * loss.weight(residuals), abs=1e-8)


@pytest.mark.parametrize("sd", [0.05, 0.2, 0.35])
@pytest.mark.parametrize("loss", LOSSES)
def test_the_normaliser_is_the_integral_of_the_density(loss, sd):
    def density(r):
        return float(np.exp(-loss.rho(np.array([r]))[0] / (2.0 * sd**2)))

    edge = min(loss.cutoff, 20.0 * sd)
    total = 2.0 * (quad(density, 0.0, edge, epsabs=1e-14)[0] + quad(density, edge, np.inf, epsabs=1e-14)[0])
    assert loss.log_normaliser(sd) == pytest.approx(np.log(total / np.sqrt(2.0 * np.pi)), abs=1e-7)


@pytest.mark.parametrize("loss", LOSSES)
def test_weights_fall_with_the_size_so_that_reweighting_lowers_the_loss(loss):
    """rho is concave in r^2: its tangent there, w r^2, lies above it (Lange, Hunter & Yang 2000)."""
    residuals = np.linspace(0.0, 3.0, 61)
    assert np.all(np.diff(loss.weight(residuals)) <= 0.0)
    for r in (0.3, 0.9, 2.5):
        at = np.array([r])
        above = loss.rho(at) + loss.weight(at) * (residuals**2 - r**2)
        assert np.all(above >= loss.rho(residuals) - 1e-12)


def test_no_residual_is_ever_without_pull_under_hubers():
    loss = Huber(0.4)
    pulls = [float(r * loss.weight(np.array([r]))[0]) for r in (0.2, 0.4, 4.0, 400.0)]
    assert pulls == pytest.approx([0.2, 0.4, 0.4, 0.4])


def test_the_pull_of_an_outlier_falls_with_its_distance():
    pulls = [float(r * PowerLaw(0.4).weight(np.array([r]))[0]) for r in (0.2, 0.4, 0.8, 400.0)]
    assert pulls == pytest.approx([0.2, 0.4, 0.2, 0.0004])
