"""Laws of linear equilibrium."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy import sparse

from palpate.errors import ConfigurationError
from palpate.mechanics.boundary import Conditions, outer_constraint
from palpate.mechanics.forward import SolveCounts
from palpate.mechanics.linear_model import linear_model
from palpate.mesh.space import lagrange_space

MODULI = np.array([2.0, 12.0, 0.5])


@pytest.fixture(scope="module", params=["P1", "P2"])
def model(request, meshes):
    """Three tissues in a box whose floor moves by three modes and an offset and whose other sides slide."""
    mesh = meshes.box_mesh(
        4,
        size=40.0,
        distortion=0.2,
        tissues=[meshes.known("fat", nu=0.45), meshes.VOID, meshes.unknown("organ", nu=0.4), meshes.unknown("gland")],
        region=lambda c: np.select([c[:, 2] < 15.0, np.linalg.norm(c - 20.0, axis=1) < 15.0], [0, 2], 3),
    )
    space = lagrange_space(mesh, request.param)
    floor = np.flatnonzero(space.points[:, 2] < 1e-9)
    rng = np.random.default_rng(5)
    given = meshes.prescribe(
        space, floor, rng.standard_normal((len(floor), 3)), rng.standard_normal((len(floor), 3, 3))
    )
    return linear_model(space, outer_constraint(space, outer="sliding", **given))


def test_regions_are_the_meshed_tissues_in_their_order(model):
    assert model.regions == (0, 2, 3)
    assert model.names == ("fat", "organ", "gland")


def test_scaling_all_moduli_leaves_the_displacement_unchanged(model, rng):
    coefficients = rng.standard_normal(3)
    once = model.solve(MODULI, coefficients).values
    assert np.allclose(model.solve(5.0 * MODULI, coefficients).values, once, rtol=0, atol=1e-12 * abs(once).max())


def test_the_displacement_is_the_superposition_of_the_unit_responses(model, rng):
    coefficients = rng.standard_normal(3)
    responses = model.responses(MODULI)
    expected = model.solve(MODULI, coefficients).values
    assert np.allclose(responses @ np.append(coefficients, 1.0), expected, atol=1e-12 * abs(expected).max())


def test_systems_at_all_moduli_have_one_pattern(model):
    """Also where parts of an entry cancel: the solver's plan is of the pattern."""
    first, second, *others = model.free_stiffness
    n = first.shape[0]
    pair = ([1.0, 1.0], ([0, n - 1], [n - 1, 0]))
    apart = sparse.csr_matrix(pair, shape=(n, n))
    cancelling = replace(model, free_stiffness=(first + 1e-3 * apart, second - 1e-3 * apart, *others))
    patterns = [cancelling.system(np.full(model.n_regions, e)).factorisation.matrix for e in (1.0, 2.0)]
    patterns.append(cancelling.system(np.linspace(1.0, 2.0, model.n_regions)).factorisation.matrix)
    assert all(np.array_equal(p.indices, patterns[0].indices) for p in patterns)
    assert patterns[0][0, n - 1] == 0.0


def test_what_is_prescribed_is_met_exactly(model, rng):
    coefficients = rng.standard_normal(3)
    given = model.constraint.modes @ coefficients + model.constraint.offset
    moved = given != 0.0
    assert moved.any()
    assert np.array_equal(model.solve(MODULI, coefficients).values[moved], given[moved])


def test_forces_on_free_points_are_those_of_all_tissues_stiffness(model, rng):
    moduli = rng.uniform(1.0, 30.0, model.n_regions)
    motion = rng.standard_normal((model.constraint.free.shape[1], 3))
    whole = model.constraint.free.T @ model.forces(moduli, model.constraint.free @ motion)
    found = model.free_forces(moduli, motion)
    assert np.allclose(found, whole, rtol=0.0, atol=1e-12 * np.abs(whole).max())


def test_free_points_feel_no_force(model, rng):
    u = model.solve(MODULI, rng.standard_normal(3)).values[:, None]
    reactions = model.forces(MODULI, u)
    assert np.linalg.norm(model.residual(MODULI, u)) < 1e-11 * np.linalg.norm(reactions)


def test_equilibrium_has_the_least_energy_of_all_admissible_displacements(model, rng):
    u = model.solve(MODULI, rng.standard_normal(3)).values
    free = model.constraint.free
    energy = u @ model.forces(MODULI, u[:, None])[:, 0]
    for _ in range(5):
        other = u + free @ (1e-3 * rng.standard_normal(free.shape[1]))
        assert other @ model.forces(MODULI, other[:, None])[:, 0] > energy


def test_rigid_motion_of_the_support_gives_no_stress(meshes):
    mesh = meshes.box_mesh(3, size=30.0, distortion=0.2)
    space = lagrange_space(mesh, "P2")
    spin = np.array([[0.0, -1.0, 2.0], [1.0, 0.0, -3.0], [-2.0, 3.0, 0.0]])  # skew: a small rotation
    motion = space.points @ spin.T + np.array([1.0, 2.0, 3.0])
    floor = np.flatnonzero(space.points[:, 2] < 1e-9)
    given = meshes.prescribe(space, floor, motion[floor])
    model = linear_model(space, outer_constraint(space, outer="free", **given))
    moduli = np.array([7.0])
    u = model.solve(moduli, np.zeros(0)).displacement
    assert np.allclose(u, motion, atol=1e-10 * abs(motion).max())
    stiffness = abs(model.stiffness[0]).max() * 7.0
    assert abs(model.forces(moduli, u.reshape(-1, 1))).max() < 1e-10 * stiffness * abs(motion).max()


def test_modulus_responses_are_the_derivatives_of_the_responses(model):
    step = 1e-4
    system = model.system(MODULI)
    derivatives = system.modulus_responses(system.responses())
    for region in range(3):
        factor = np.exp(step * np.eye(3)[region])
        difference = (model.responses(MODULI * factor) - model.responses(MODULI / factor)) / (2.0 * step)
        assert np.allclose(derivatives[region], difference, atol=1e-6 * abs(derivatives).max())


def test_modulus_responses_sum_to_zero_when_no_load_sets_a_scale(model):
    system = model.system(MODULI)
    derivatives = system.modulus_responses(system.responses())
    assert abs(derivatives.sum(axis=0)).max() < 1e-11 * abs(derivatives).max()


def test_the_error_bound_is_the_error_at_its_own_moduli_and_never_below_it_elsewhere(model, rng):
    exact = model.solve(MODULI, np.ones(3)).values
    free = model.constraint.free
    wrong = exact + free @ (0.05 * rng.standard_normal(free.shape[1]))
    error = wrong - exact
    energy = [v @ model.forces(MODULI, v[:, None])[:, 0] for v in (error, wrong)]
    truth = np.sqrt(energy[0] / energy[1])
    assert model.system(MODULI).error_bound(MODULI, wrong)[0] == pytest.approx(truth, rel=1e-9)
    for frozen in ([1.0, 1.0, 1.0], [4.0, 6.0, 1.0]):
        bound = model.system(np.array(frozen)).error_bound(MODULI, wrong)[0]
        assert truth <= bound <= 30.0 * truth


def test_counts_say_what_was_solved(model):
    system = model.system(MODULI)
    equilibrium = system.solve(np.ones(3))
    assert equilibrium.counts == SolveCounts(forward=1, factorisations=1)
    assert equilibrium.tangent_counts == SolveCounts(tangent=6)
    assert system.response_counts == SolveCounts(forward=4, factorisations=1)


@pytest.mark.parametrize("moduli", [[1.0, 2.0], [1.0, -2.0, 3.0], [1.0, np.nan, 3.0]])
def test_impossible_moduli_are_refused(model, moduli):
    with pytest.raises(ConfigurationError, match="organ"):
        model.solve(np.array(moduli), np.zeros(3))


def test_a_wrong_number_of_mode_coefficients_is_refused(model):
    with pytest.raises(ConfigurationError, match="give 3"):
        model.solve(MODULI, np.zeros(2))


def test_a_constraint_of_another_space_is_refused(model, meshes):
    with pytest.raises(ConfigurationError, match="same space"):
        linear_model(lagrange_space(meshes.box_mesh(1), "P1"), model.constraint)


def test_other_modes_of_the_same_points_need_no_new_assembly(model):
    constraint = replace(model.constraint, modes=model.constraint.modes[:, :2], offset=3.0 * model.constraint.offset)
    quick, anew = model.with_conditions(Conditions(constraint)), linear_model(model.space, constraint)
    assert quick.stiffness is model.stiffness
    found, expected = (m.solve(MODULI, np.array([1.0, -2.0])).values for m in (quick, anew))
    assert np.allclose(found, expected, atol=1e-12 * abs(expected).max())


def test_a_constraint_that_frees_other_points_needs_a_new_assembly(model, meshes):
    points = np.unique(model.space.facets(model.space.mesh.boundary))
    given = meshes.prescribe(model.space, points, np.zeros((len(points), 3)))
    with pytest.raises(ConfigurationError, match="other free displacements"):
        model.with_conditions(Conditions(outer_constraint(model.space, outer="free", **given)))
