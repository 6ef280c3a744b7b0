"""Reduced models stand for the full one: exact where they were made, certified elsewhere."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from palpate.inversion.directions import deciding_directions
from palpate.inversion.surrogate import SERIES, enriched, first_surrogate, sharpened, with_modulus_series, with_offset
from palpate.inversion.weighting import SEGMENTATION_LAW, objective_of

from palpate.mechanics.linear_model import with_constraint


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


def directions_at(surrogate, twin, exact):
    """The deciding directions at the truth, with the evaluation that they come from."""
    objective = objective_of(exact, (surrogate.reduced,), SEGMENTATION_LAW).with_fresh_correspondence(twin.unknowns)
    evaluation = objective(twin.unknowns)
    return deciding_directions(objective, evaluation)[0], evaluation


def test_sharpening_makes_displacement_and_deciding_derivatives_exact_there(first, twin, exact):
    directions, _ = directions_at(first, twin, exact)
    sharper = sharpened(first, twin.moduli, twin.coefficients, directions)
    truth = twin.model.solve(twin.moduli, twin.coefficients)
    found = sharper.reduced.solve(twin.moduli, twin.coefficients)
    assert sharper.relative_error(twin.moduli, twin.coefficients) < 1e-3 * first.relative_error(
        twin.moduli, twin.coefficients
    )
    along, exactly, before = (
        e.tangent() @ directions for e in (found, truth, first.reduced.solve(twin.moduli, twin.coefficients))
    )
    assert np.linalg.norm(along - exactly) < 0.03 * np.linalg.norm(before - exactly)
    assert sharper.reduced.n_basis <= first.reduced.n_basis + 1 + directions.shape[1]


def test_sharpening_factorises_only_where_the_moduli_are_far(first, twin, exact):
    directions, _ = directions_at(first, twin, exact)
    near = sharpened(first, twin.moduli, twin.coefficients, directions)
    assert near.counts.factorisations == first.counts.factorisations
    assert near.factorisation is first.factorisation
    far = twin.moduli * np.where(np.arange(len(twin.moduli)) == 0, 100.0, 1.0)
    there = sharpened(first, far, twin.coefficients, directions)
    assert there.counts.factorisations == first.counts.factorisations + 1
    assert there.relative_error(far, twin.coefficients) < 1e-6


def test_exact_deciding_derivatives_give_the_posterior_of_the_full_model(twin, exact):
    """The other columns may be off: the moduli's variance is stationary in them."""
    plain = first_surrogate(twin.model, exact.modulus_map.moduli(np.zeros(2)))
    directions, _ = directions_at(plain, twin, exact)
    sharper = sharpened(plain, twin.moduli, twin.coefficients, directions)
    full = enriched(plain, twin.moduli, twin.coefficients)
    variances = [np.diag(np.linalg.inv(directions_at(s, twin, exact)[1].matrix))[:2] for s in (plain, sharper, full)]
    off = [np.max(np.abs(v / variances[2] - 1.0)) for v in variances[:2]]
    assert off[1] < 0.01
    assert off[1] < 0.2 * off[0]


def test_a_new_offset_keeps_the_vectors_and_adds_its_response(first, twin):
    constraint = twin.model.constraint
    moved = replace(constraint, offset=constraint.offset + 0.3 * constraint.modes[:, 1])
    model = with_constraint(twin.model, moved)
    changed = with_offset(first, model)
    moduli = first.system.moduli
    truth = model.solve(moduli, twin.coefficients).values
    assert changed.reduced.solve(moduli, twin.coefficients).values == pytest.approx(truth, abs=1e-8)
    assert changed.reduced.n_basis <= first.reduced.n_basis + 1
