"""Reduced models stand for the full one: exact where they were made, certified elsewhere."""

from __future__ import annotations

import numpy as np
import pytest

from palpate.inversion.surrogate import SERIES, enriched, first_surrogate, with_modulus_series


@pytest.fixture(scope="module")
def first(twin, exact):
    plain = first_surrogate(twin.model, exact.modulus_map.moduli(np.zeros(2)))
    return with_modulus_series(plain, twin.coefficients, exact.modulus_map.columns)


def energy_error(model, moduli, values, truth):
    energies = [v @ model.forces(moduli, v[:, None])[:, 0] for v in (values - truth, truth)]
    return float(np.sqrt(energies[0] / energies[1]))


def test_it_is_exact_where_it_was_made(first, twin, exact):
    moduli = exact.modulus_map.moduli(np.zeros(2))
    truth = twin.model.solve(moduli, twin.coefficients)
    found = first.reduced.solve(moduli, twin.coefficients)
    assert found.values == pytest.approx(truth.values, abs=1e-8)
    columns = np.append(exact.modulus_map.columns, 3 + np.arange(twin.model.n_modes))
    assert found.tangent()[:, columns] == pytest.approx(truth.tangent()[:, columns], abs=1e-6)


def test_the_series_carries_a_displacement_over_a_wide_range_of_moduli(first, twin, exact):
    plain = first_surrogate(twin.model, exact.modulus_map.moduli(np.zeros(2)))
    for theta in ([1.4, -1.4], [-1.4, -1.4], [2.0, 2.0]):
        moduli = exact.modulus_map.moduli(np.array(theta))
        truth = twin.model.solve(moduli, twin.coefficients).values
        error, poor = (
            energy_error(twin.model, moduli, s.reduced.solve(moduli, twin.coefficients).values, truth)
            for s in (first, plain)
        )
        assert error < 0.01
        assert error < 0.1 * poor


def test_its_error_elsewhere_is_certified(first, twin):
    truth = twin.model.solve(twin.moduli, twin.coefficients).values
    found = first.reduced.solve(twin.moduli, twin.coefficients).values
    error = energy_error(twin.model, twin.moduli, found, truth)
    assert 1e-6 < error <= first.relative_error(twin.moduli, twin.coefficients) < 50.0 * error


def test_enriching_makes_it_exact_there_and_keeps_it_where_it_was(first, twin, exact):
    richer = enriched(first, twin.moduli, twin.coefficients)
    assert richer.relative_error(twin.moduli, twin.coefficients) < 1e-7
    elsewhere = richer.reduced.solve(exact.modulus_map.moduli(np.zeros(2)), twin.coefficients)
    truth = twin.model.solve(exact.modulus_map.moduli(np.zeros(2)), twin.coefficients)
    assert elsewhere.values == pytest.approx(truth.values, abs=1e-8)


def test_what_it_cost_adds_up(first, twin):
    modes = twin.model.n_modes
    assert (first.counts.forward, first.counts.factorisations) == (modes + 1, 1)
    assert 2 + 4 + 8 <= first.counts.tangent <= SERIES
    richer = enriched(first, twin.moduli, twin.coefficients)
    assert (richer.counts.forward, richer.counts.factorisations) == (2 * (modes + 1), 2)
