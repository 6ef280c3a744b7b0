"""Reduced models stand for the full one: exact where they were made, certified elsewhere."""

from __future__ import annotations

import numpy as np
import pytest

from palpate.inversion.surrogate import enriched, first_surrogate


@pytest.fixture(scope="module")
def first(twin, exact):
    return first_surrogate(twin.model, exact.modulus_map.moduli(np.zeros(2)), exact.modulus_map.columns)


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
    assert (first.counts.forward, first.counts.tangent, first.counts.factorisations) == (modes + 1, 2 * (modes + 1), 1)
    richer = enriched(first, twin.moduli, twin.coefficients)
    assert (richer.counts.forward, richer.counts.factorisations) == (2 * (modes + 1), 2)
