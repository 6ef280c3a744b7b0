"""Reduced models stand for the full one: exact where they were made, certified elsewhere."""

from __future__ import annotations

import numpy as np
import pytest

from palpate.approximation import LinearisationPoint, ReducedBasis, reduced_basis
from palpate.approximation.reduced_basis import SERIES
from palpate.inversion.objective import deciding_directions
from palpate.observation.noise_model import SEGMENTATION_NOISE


@pytest.fixture(scope="module")
def equal(exact):
    """Moduli at equal ratios."""
    return exact.parameters.moduli(np.zeros(2))


@pytest.fixture(scope="module")
def plain(twin, equal):
    return reduced_basis(twin.model, equal)


@pytest.fixture(scope="module")
def first(twin, exact, plain):
    return plain.with_modulus_series(twin.coefficients, exact.parameters.selection)


def energy_error(model, moduli, values, truth):
    energies = [v @ model.forces(moduli, v[:, None])[:, 0] for v in (values - truth, truth)]
    return float(np.sqrt(energies[0] / energies[1]))


def test_it_is_exact_where_it_was_made(first, twin, equal):
    truth = twin.model.solve(equal, twin.coefficients)
    found = first.model.solve(equal, twin.coefficients)
    assert found.values == pytest.approx(truth.values, abs=1e-8)
    sought = [0, 1, *range(3, 3 + twin.model.n_modes)]
    assert found.tangent()[:, sought] == pytest.approx(truth.tangent()[:, sought], abs=1e-6)


def test_the_series_carries_a_displacement_over_a_wide_range_of_moduli(first, plain, twin, exact):
    for theta in ([1.4, -1.4], [-1.4, -1.4], [2.0, 2.0]):
        moduli = exact.parameters.moduli(np.array(theta))
        truth = twin.model.solve(moduli, twin.coefficients).values
        error, poor = (
            energy_error(twin.model, moduli, basis.model.solve(moduli, twin.coefficients).values, truth)
            for basis in (first, plain)
        )
        assert error < 0.01
        assert error < 0.1 * poor


def test_a_series_of_tied_tissues_follows_their_common_modulus_with_fewer_vectors(plain, first, twin, equal):
    tied = plain.with_modulus_series(twin.coefficients, np.array([[1.0], [1.0], [0.0]]))
    moduli = equal * [4.0, 4.0, 1.0]
    truth = twin.model.solve(moduli, twin.coefficients).values
    assert energy_error(twin.model, moduli, tied.model.solve(moduli, twin.coefficients).values, truth) < 0.01
    apart = equal * [4.0, 0.25, 1.0]
    assert (
        tied.error(LinearisationPoint(apart, twin.coefficients)).relative
        > 10.0 * first.error(LinearisationPoint(apart, twin.coefficients)).relative
    )


def test_adding_all_responses_makes_it_exact_there_and_keeps_it_where_it_was(first, twin, equal):
    richer = first.with_responses(twin.moduli, twin.coefficients)
    assert richer.error(LinearisationPoint(twin.moduli, twin.coefficients)).relative < 1e-7
    elsewhere = richer.model.solve(equal, twin.coefficients)
    assert elsewhere.values == pytest.approx(twin.model.solve(equal, twin.coefficients).values, abs=1e-8)


def test_what_it_cost_adds_up(first, twin):
    modes = twin.model.n_modes
    assert (first.counts.forward, first.counts.factorisations) == (modes + 1, 1)
    assert 2 + 4 + 8 <= first.counts.tangent <= SERIES
    richer = first.with_responses(twin.moduli, twin.coefficients)
    assert (richer.counts.forward, richer.counts.factorisations) == (2 * (modes + 1), 2)


def evaluated(twins, problem, basis, unknowns):
    """The evaluation on a basis at some unknowns, by the noise of segmentations."""
    objective = twins.objective_of(problem).with_approximations([basis])
    rough = objective.with_observations([o.with_noise(SEGMENTATION_NOISE) for o in objective.observations])
    return rough.rematched(unknowns)(unknowns)


@pytest.fixture(scope="module")
def directions(twins, twin, exact, first):
    """The deciding directions at the truth."""
    found = evaluated(twins, exact, first, twin.unknowns)
    return exact.parameters.chain(0, twin.unknowns) @ deciding_directions(found, 2)


def test_an_update_makes_displacement_and_deciding_derivatives_exact_there(first, twin, directions):
    there = LinearisationPoint(twin.moduli, twin.coefficients, directions)
    sharper, truth = first.update(there), twin.model.solve(twin.moduli, twin.coefficients)
    found, before = (basis.model.solve(twin.moduli, twin.coefficients) for basis in (sharper, first))
    assert sharper.error(there).relative < 1e-3 * first.error(there).relative
    along, exactly, poor = (e.tangent() @ directions for e in (found, truth, before))
    assert np.linalg.norm(along - exactly) < 0.03 * np.linalg.norm(poor - exactly)
    assert sharper.model.n_basis <= first.model.n_basis + 1 + directions.shape[1]


def test_an_update_factorises_only_where_the_moduli_are_far(first, twin, directions):
    near = first.update(LinearisationPoint(twin.moduli, twin.coefficients, directions))
    assert near.counts.factorisations == first.counts.factorisations
    assert near.factorisation is first.factorisation
    far = LinearisationPoint(twin.moduli * [100.0, 1.0, 1.0], twin.coefficients, directions)
    there = first.update(far)
    assert there.counts.factorisations == first.counts.factorisations + 1
    assert there.error(far).relative < 1e-6


@pytest.mark.parametrize(("stiffer", "made"), [(1.0, 0), (100.0, 1)])
def test_states_of_one_body_are_made_exact_together_as_each_is_alone(first, twin, directions, stiffer, made):
    """By one factorisation where the moduli are far."""
    moduli = twin.moduli * [stiffer, 1.0, 1.0]
    points = [LinearisationPoint(moduli, share * twin.coefficients, directions) for share in (1.0, -0.5, 0.2)]
    together = ReducedBasis.update_all([first] * 3, points)
    for basis, at in zip(together, points, strict=True):
        here, alone = (of.model.solve(moduli, at.coefficients) for of in (basis, first.update(at)))
        assert here.values == pytest.approx(alone.values, abs=1e-4 * np.abs(alone.values).max())
        ways = [there.tangent() @ directions for there in (here, alone)]
        assert np.linalg.norm(ways[0] - ways[1]) < 1e-3 * np.linalg.norm(ways[1])
        assert basis.factorisation is together[0].factorisation
    spent = [basis.counts - first.counts for basis in together]
    assert sum(counts.factorisations for counts in spent) == made
    assert all(counts.forward == 1 for counts in spent)


def test_however_many_are_sought_nothing_is_factorised_again_where_it_was(first, equal, twin, directions):
    points = [LinearisationPoint(equal, share * twin.coefficients, directions) for share in np.linspace(-1.0, 1.0, 300)]
    bases = ReducedBasis.update_all([first] * len(points), points)
    assert all(basis.factorisation is first.factorisation for basis in bases)


def test_an_update_where_it_is_exact_already_solves_no_displacement_again(first, twin, directions):
    once = first.update(LinearisationPoint(twin.moduli, twin.coefficients))
    twice = once.update(LinearisationPoint(twin.moduli, twin.coefficients, directions))
    assert twice.counts.forward == once.counts.forward == first.counts.forward + 1
    assert twice.counts.tangent == once.counts.tangent + directions.shape[1]


def test_exact_deciding_derivatives_give_the_posterior_of_the_full_model(twins, twin, exact, plain):
    """The other columns may be off: the moduli's variance is stationary in them."""
    found = evaluated(twins, exact, plain, twin.unknowns)
    along = exact.parameters.chain(0, twin.unknowns) @ deciding_directions(found, 2)
    sharper = plain.update(LinearisationPoint(twin.moduli, twin.coefficients, along))
    full = plain.with_responses(twin.moduli, twin.coefficients)
    matrices = [evaluated(twins, exact, basis, twin.unknowns).matrix.dense for basis in (plain, sharper, full)]
    variances = [np.diag(np.linalg.inv(matrix))[:2] for matrix in matrices]
    off = [np.max(np.abs(v / variances[2] - 1.0)) for v in variances[:2]]
    assert off[1] < 0.01
    assert off[1] < 0.2 * off[0]
