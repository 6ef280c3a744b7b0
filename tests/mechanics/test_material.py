"""Modes of the material: what a body does whose tissues are not homogeneous, and its derivatives."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy import sparse

from palpate.approximation.contract import LinearisationPoint
from palpate.approximation.reduced_basis import reduced_basis
from palpate.images.tissue import Role, Tissue
from palpate.mechanics.boundary import outer_constraint
from palpate.mechanics.dilatation import Dilatation
from palpate.mechanics.finite_strain import finite_strain_model
from palpate.mechanics.laws.neo_hookean import NeoHookean
from palpate.mechanics.linear_model import linear_model
from palpate.mechanics.material import MaterialModes, material_modes
from palpate.mechanics.newton import NewtonSettings
from palpate.mesh.anatomy import Anatomy, Box
from palpate.mesh.layers import layered_space, layers_round_organs
from palpate.mesh.space import lagrange_space
from palpate.mesh.tetrahedralise import tetrahedralise
from palpate.observation.prescribed_motion import prescribed_motion
from palpate.phantoms.shapes import ball

MODULI = np.array([30.0, 10.0])


@pytest.fixture(scope="module")
def body():
    """A gland beside a driver, in a box, with its constraint."""
    tissues = (
        Tissue("gland", Role.ESTIMATE, (1,), 0.40),
        Tissue("tube", Role.DRIVER, (2,)),
        Tissue("rest", Role.KNOWN, (3,), 0.43, youngs_modulus_kpa=10.0),
    )
    box = Box(np.full(3, -20.0), np.eye(3), np.full(3, 40.0))
    shapes = (ball([0.0, -7.0, 0.0], 7.0), ball([0.0, 9.0, 0.0], 6.0), None)
    space = lagrange_space(tetrahedralise(Anatomy(tissues, shapes, box), edge_length_mm=7.0), "P1")
    motion = prescribed_motion(space, {}, n_modes=6, kernel_mm=12.0, prior_mm=2.0)
    given = {"modes": motion.modes, "offset": motion.offset, "prescribed": motion.prescribed}
    return space, outer_constraint(space, outer="fixed", **given)


@pytest.fixture(scope="module")
def modes(body):
    return material_modes(body[0].mesh, (0, 2), length_mm=15.0, poisson=((0,), (2,)))


@pytest.fixture(scope="module")
def coefficients(body, modes):
    rng = np.random.default_rng(3)
    boundary = rng.normal(size=body[1].n_modes)
    return boundary, np.concatenate([0.3 * rng.normal(size=modes.fields.shape[1]), [0.01, -0.02]])


def finite(body, modes):
    return finite_strain_model(*body, NeoHookean(), material=modes, settings=NewtonSettings(tolerance=1e-11))


@pytest.fixture(scope="module")
def there(body, modes, coefficients):
    """The patchy body at these coefficients, under the neo-Hookean law."""
    return finite(body, modes).solve(MODULI, np.concatenate(coefficients))


@pytest.fixture(scope="module")
def tangent(there):
    return there.tangent()


def test_the_modulus_of_a_tissue_is_the_geometric_mean_over_it(body, modes, coefficients):
    mesh = body[0].mesh
    logarithms = np.log(modes.scale(coefficients[1]))
    assert logarithms.std() > 0.05
    for tissue in (0, 2):
        own = mesh.region == tissue
        assert np.average(logarithms[own], weights=mesh.volumes[own]) == pytest.approx(0.0, abs=1e-12)


def test_fields_have_the_covariance_of_their_kernel(body, modes):
    """But for the mean that is taken off and the twentieth of the variance that is left out."""
    mesh = body[0].mesh
    own = np.flatnonzero(mesh.region == 2)
    centres, volumes = mesh.nodes[mesh.tets].mean(axis=1)[own], mesh.volumes[own]
    kernel = np.exp(-np.sum((centres[:, None] - centres) ** 2, axis=2) / (2.0 * 15.0**2))
    mean = np.eye(len(own)) - volumes / volumes.sum()
    fields = modes.fields[own].toarray()
    assert np.abs(fields @ fields.T - mean @ kernel @ mean.T).mean() < 0.03


def test_a_field_that_is_the_same_everywhere_in_a_tissue_is_a_modulus(body, coefficients):
    mesh = body[0].mesh
    uniform = MaterialModes(sparse.csr_matrix((mesh.region == 0).astype(float)[:, None]))
    moved = finite(body, uniform).solve(MODULI, np.append(coefficients[0], np.log(2.0))).values
    stiffer = finite(body, uniform).solve(MODULI * [2.0, 1.0], np.append(coefficients[0], 0.0)).values
    assert moved == pytest.approx(stiffer, abs=1e-8)


def test_all_moduli_scaled_together_leave_a_patchy_body_where_it_is(body, modes, coefficients, there):
    scaled = finite(body, modes).solve(5.0 * MODULI, np.concatenate(coefficients))
    assert scaled.values == pytest.approx(there.values, abs=1e-8)


@pytest.mark.parametrize("column", [-9, -3, -2, -1])
def test_the_derivative_by_a_material_mode_is_that_of_finite_differences(
    body, modes, coefficients, there, tangent, column
):
    model, every = finite(body, modes), np.concatenate(coefficients)
    step = np.zeros(len(every))
    step[column] = 1e-4
    ahead, behind = (model.solve(MODULI, every + sign * step).values for sign in (1.0, -1.0))
    expected = (ahead - behind) / 2e-4
    assert tangent[:, column] == pytest.approx(expected, abs=1e-5 * np.abs(expected).max())
    direction = np.zeros((2 + len(every), 1))
    direction[column] = 1.0  # counted from the end: moduli come first
    found = there.tangent_along(direction, np.zeros((len(there.values), 1)))[:, 0]
    assert np.linalg.norm(found - expected) < 2e-2 * np.linalg.norm(expected)


def test_the_adjoint_of_a_patchy_body_is_its_transposed_tangent(there, tangent, rng):
    gradient = rng.normal(size=len(there.values))
    assert there.adjoint(gradient) == pytest.approx(tangent.T @ gradient, rel=1e-6, abs=1e-6)


def test_forces_along_a_single_direction_of_the_material_are_those_among_several(body, modes, coefficients, rng):
    model, values = linear_model(*body, material=modes), rng.normal(size=3 * len(body[0].points))
    directions = np.column_stack([coefficients[1], rng.normal(size=modes.n_modes)])
    every = model.material_forces(MODULI, values, directions)
    single = [model.material_forces(MODULI, values, d[:, None])[:, 0] for d in directions.T]
    assert np.column_stack(single) == pytest.approx(every, abs=1e-12 * np.abs(every).max())
    assert np.abs(every).max() > 1.0


class Counted:
    """A factorisation that counts the right-hand sides it solves."""

    def __init__(self, factorisation):
        self.factorisation, self.solved = factorisation, 0

    def solve(self, rhs, **tolerance):
        self.solved += rhs.shape[1]
        return self.factorisation.solve(rhs, **tolerance)


@pytest.mark.parametrize("length_mm", [15.0, 5.0])
def test_a_gradient_by_all_modes_takes_one_solve_however_many_they_are(body, rng, length_mm):
    modes = material_modes(body[0].mesh, (0, 2), length_mm=length_mm, poisson=((0,), (2,)))
    model = linear_model(*body, material=modes)
    system = model.system(MODULI)
    there = replace(system, factorisation=Counted(system.factorisation)).solve(0.1 * rng.normal(size=model.n_modes))
    before = there.system.factorisation.solved
    gradient = there.adjoint(rng.normal(size=len(there.values)))
    assert before == 2  # the displacement of homogeneous tissues, and what the material changes of it
    assert there.system.factorisation.solved - before == 1
    assert len(gradient) == 2 + body[1].n_modes + modes.n_modes
    assert np.all(gradient != 0.0)


def test_a_reduced_basis_tells_what_its_responses_to_the_material_miss_elsewhere(body, modes, coefficients):
    """All of them are those at the moduli where it was made, its displacement of homogeneous tissues is exact."""
    model, (boundary, material) = linear_model(*body, material=modes), coefficients
    moduli = MODULI * [1.4, 1.0]
    there = LinearisationPoint(moduli, np.concatenate([boundary, material]))
    homogeneous = LinearisationPoint(moduli, np.concatenate([boundary, 0.0 * material]))
    first = reduced_basis(model, MODULI)
    values = model.solve(MODULI, homogeneous.coefficients).values
    first = first.with_material(first.system.material_responses(values), MODULI, values)
    basis = first.update(homogeneous)
    missing = model.solve(moduli, there.coefficients).values - basis.model.solve(moduli, there.coefficients).values
    assert basis.error(homogeneous).relative < 1e-5
    assert np.linalg.norm(basis.error(there).missing - missing) < 0.3 * np.linalg.norm(missing)


@pytest.fixture(scope="module")
def responding(body, modes, coefficients):
    """The linear model, boundary coefficients without material, and a basis with the responses to the material."""
    model = linear_model(*body, material=modes)
    homogeneous = np.concatenate([coefficients[0], 0.0 * coefficients[1]])
    basis, values = reduced_basis(model, MODULI), model.solve(MODULI, homogeneous).values
    return model, homogeneous, basis.with_material(basis.system.material_responses(values), MODULI, values)


def by_material(of, moduli, coefficients):
    """Derivatives (n_dof, n_material) mm by the material modes."""
    return of.solve(moduli, coefficients).tangent()[:, of.n_regions + of.n_boundary :]


def material_responses(model, moduli, coefficients):
    """The same of a full model."""
    return model.solve(moduli, coefficients).tangent()[:, model.n_regions + model.constraint.n_modes :]


def misses(found, exact):
    """Of each response, over its length."""
    return np.linalg.norm(found - exact, axis=0) / np.linalg.norm(exact, axis=0)


def test_a_reduced_basis_has_the_full_model_s_responses_to_the_material_where_they_were_made(responding):
    model, homogeneous, basis = responding
    exact = material_responses(model, MODULI, homogeneous)
    assert misses(by_material(basis.model, MODULI, homogeneous), exact).max() < 1e-6
    scaled = by_material(basis.model, 7.0 * MODULI, homogeneous)  # nothing but displacements is prescribed
    assert misses(scaled, exact).max() < 1e-6


@pytest.mark.parametrize("away", [(1.0, 0.0), (-1.0, 0.0), (0.0, 1.0), (0.5, -0.5)])
def test_responses_to_the_material_follow_the_moduli_where_the_displacement_is_made_exact(responding, away):
    """A factor of e away in the ratio of moduli they are nearer to the full model's than those held, and by half."""
    model, homogeneous, basis = responding
    moduli = MODULI * np.exp(away)
    exact, held = (material_responses(model, at, homogeneous) for at in (moduli, MODULI))
    there = basis.update(LinearisationPoint(moduli, homogeneous))
    assert np.array_equal(there.material_at, MODULI)  # no response is made anew
    found = by_material(there.model, moduli, homogeneous)
    assert np.mean(misses(found, exact) < misses(held, exact)) > 0.9
    assert np.linalg.norm(found - exact) < 0.75 * np.linalg.norm(held - exact)
    assert np.mean(misses(found, exact) ** 2) < 0.5 * np.mean(misses(held, exact) ** 2)


def test_derivatives_of_a_patchy_body_by_moduli_are_those_of_the_reduced_model_s_own_differences(
    responding, coefficients
):
    _, homogeneous, basis = responding
    every, h = np.concatenate(coefficients), 1e-4
    tangent = basis.model.solve(MODULI, every).tangent()
    for region, step in enumerate(h * np.eye(2)):
        ahead, behind = (basis.model.solve(MODULI * np.exp(sign * step), every).values for sign in (1.0, -1.0))
        assert tangent[:, region] == pytest.approx((ahead - behind) / (2.0 * h), abs=1e-6)
    assert np.any(tangent[:, :2] != basis.model.solve(MODULI, homogeneous).tangent()[:, :2])


def test_an_updated_reduced_basis_misses_nothing_of_what_follows_the_material(body, modes, coefficients, rng):
    """Where it was updated: the material's coefficients there are no combination of the directions that decide."""
    model, every = linear_model(*body, material=modes), np.concatenate(coefficients)
    first = reduced_basis(model, MODULI)
    values = model.solve(MODULI, np.concatenate([coefficients[0], 0.0 * coefficients[1]])).values
    first = first.with_material(first.system.material_responses(values), MODULI, values)
    n = model.n_regions + len(every)
    directions = rng.normal(size=(n, 2))
    at = LinearisationPoint(MODULI * [1.2, 1.0], every, directions, np.eye(n))
    basis = first.update(at)
    missing = model.solve(at.moduli, every).values - basis.model.solve(at.moduli, every).values
    before = model.solve(at.moduli, every).values - first.model.solve(at.moduli, every).values
    assert first.error(at).relative > 1e-3
    assert basis.error(at).relative < 0.05 * first.error(at).relative
    assert np.linalg.norm(missing) < 0.05 * np.linalg.norm(before)


def test_responses_to_the_material_are_made_anew_far_away_without_another_factorisation(body, modes, coefficients, rng):
    model, every = linear_model(*body, material=modes), np.concatenate(coefficients)
    first = reduced_basis(model, MODULI)
    values = model.solve(MODULI, np.concatenate([coefficients[0], 0.0 * coefficients[1]])).values
    first = first.with_material(first.system.material_responses(values), MODULI, values)
    moduli, n, column = MODULI * [3.0, 1.0], model.n_regions + len(every), model.n_regions + body[1].n_modes
    basis = first.update(LinearisationPoint(moduli, every, rng.normal(size=(n, 2)), np.eye(n)))
    homogeneous = np.concatenate([coefficients[0], 0.0 * coefficients[1]])
    exact, found = (of.solve(moduli, homogeneous).tangent()[:, column:] for of in (model, basis.model))
    assert basis.counts.factorisations == first.counts.factorisations
    assert np.array_equal(basis.material_at, moduli)
    assert np.all(np.linalg.norm(found - exact, axis=0) < 0.005 * np.linalg.norm(exact, axis=0))


def test_far_away_what_decides_is_exact_where_no_response_to_every_material_mode_is_asked_for(
    body, modes, coefficients, rng
):
    """Those of the directions alone, at the material's coefficients there."""
    model, every = linear_model(*body, material=modes), np.concatenate(coefficients)
    first = reduced_basis(model, MODULI)
    values = model.solve(MODULI, np.concatenate([coefficients[0], 0.0 * coefficients[1]])).values
    first = first.with_material(first.system.material_responses(values), MODULI, values)
    moduli, n, boundary = MODULI * [2.0, 1.0], model.n_regions + len(every), model.n_regions + body[1].n_modes
    directions = rng.normal(size=(n, 2))
    basis = first.update(LinearisationPoint(moduli, every, directions, np.eye(n), all_material=False))
    homogeneous = np.concatenate([coefficients[0], 0.0 * coefficients[1]])
    along = [
        of.solve(moduli, homogeneous).tangent()[:, boundary:] @ directions[boundary:] for of in (model, basis.model)
    ]
    assert np.array_equal(basis.material_at, MODULI)
    assert np.linalg.norm(along[1] - along[0]) < 0.02 * np.linalg.norm(along[0])


@pytest.mark.parametrize("dilatation", list(Dilatation))
def test_the_linear_law_is_the_small_strain_limit_of_a_patchy_body(body, modes, coefficients, dilatation):
    """To first order in the material: a hundredth of the motion and of the modes, derivatives and all."""
    linear = linear_model(*body, dilatation=dilatation, material=modes)
    model = finite_strain_model(
        *body, NeoHookean(), dilatation=dilatation, material=modes, settings=NewtonSettings(tolerance=1e-11)
    )
    amounts = np.concatenate([1e-3 * coefficients[0], 1e-3 * coefficients[1]])
    small, exact = linear.solve(MODULI, amounts), model.solve(MODULI, amounts)
    assert np.linalg.norm(small.values - exact.values) < 2e-3 * np.linalg.norm(exact.values)
    first = 2 + body[1].n_modes
    by_material, expected = small.tangent()[:, first:], exact.tangent()[:, first:]
    assert np.linalg.norm(by_material - expected) < 5e-3 * np.linalg.norm(expected)
    gradient = np.random.default_rng(1).normal(size=len(small.values))
    assert small.adjoint(gradient) == pytest.approx(small.tangent().T @ gradient, rel=1e-6, abs=1e-6)


@pytest.mark.parametrize("law", ["linear", "neo-hookean"])
def test_layers_that_are_as_stiff_as_their_tissue_change_nothing(body, modes, coefficients, law):
    """Nor do they where the tissue is patchy and its Poisson's ratio another than the stated one."""
    space, constraint = body
    layered = layered_space(space, layers_round_organs(space.mesh))
    split = MaterialModes(modes.fields, ((0,), (2, 3)), modes.sizes)
    every = np.concatenate([1e-1 * coefficients[0], coefficients[1]])
    found = []
    for on, material, moduli in ((space, modes, MODULI), (layered, split, np.append(MODULI, MODULI[1]))):
        model = (
            linear_model(on, constraint, material=material)
            if law == "linear"
            else finite_strain_model(
                on, constraint, NeoHookean(), material=material, settings=NewtonSettings(tolerance=1e-11)
            )
        )
        there = model.solve(moduli, every)
        found.append((there.values, there.tangent()[:, len(moduli) :]))
    assert layered.mesh.region.max() == 3
    assert found[1][0] == pytest.approx(found[0][0], abs=1e-8)
    assert found[1][1] == pytest.approx(found[0][1], abs=1e-6)
