"""Laws of equilibrium at finite strain, and what happens where there is none."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from palpate.errors import ConfigurationError, NotConverged
from palpate.mechanics.balance import TissueBalance
from palpate.mechanics.boundary import Conditions, outer_constraint
from palpate.mechanics.dilatation import Dilatation
from palpate.mechanics.finite_strain import finite_strain_model
from palpate.mechanics.laws.registry import LAWS
from palpate.mechanics.linear_model import linear_model
from palpate.mechanics.newton import NewtonSettings
from palpate.mechanics.solvers.registry import SOLVERS
from palpate.mesh.space import lagrange_space

MODULI = np.array([3.0, 12.0])
FINITE = sorted(name for name, law in LAWS.items() if law.finite)


@pytest.fixture(scope="module", params=FINITE)
def model(request, meshes):
    return finite_strain_model(*meshes.pushed_block(), LAWS[request.param])


@pytest.mark.parametrize("dilatation", Dilatation)
@pytest.mark.parametrize("outer", ["fixed", "sliding"])
def test_the_linear_law_gives_the_linear_model(meshes, dilatation, outer):
    space, constraint = meshes.pushed_block(outer=outer, n=2)
    expected = linear_model(space, constraint, dilatation=dilatation).solve(MODULI, np.array([4.0, 2.0]))
    found = finite_strain_model(space, constraint, LAWS["linear"], dilatation=dilatation).solve(
        MODULI, np.array([4.0, 2.0])
    )
    assert np.allclose(found.values, expected.values, atol=1e-11)
    assert np.allclose(found.tangent(), expected.tangent(), atol=1e-10)
    assert found.path.iterations == 1


def test_small_motions_are_those_of_the_linear_model(model):
    linear = linear_model(model.space, model.constraint, dilatation=Dilatation.BLENDED)
    gaps = []
    for size in (1e-2, 1e-3):
        q = size * np.array([1.0, 0.5])
        expected = linear.solve(MODULI, q).values
        gaps.append(abs(model.solve(MODULI, q).values - expected).max() / abs(expected).max())
    assert gaps[1] < 0.12 * gaps[0] < 1e-3


def test_what_is_prescribed_is_met_exactly(model):
    q = np.array([5.0, 2.0])
    given = model.constraint.modes @ q
    assert np.array_equal(model.solve(MODULI, q).values[given != 0.0], given[given != 0.0])


def test_scaling_all_moduli_leaves_the_displacement_unchanged(model):
    q = np.array([5.0, 2.0])
    once = model.solve(MODULI, q).values
    assert np.allclose(model.solve(5.0 * MODULI, q).values, once, atol=1e-8)


def test_free_points_feel_no_force(model):
    equilibrium = model.solve(MODULI, np.array([5.0, 2.0]))
    forces, size = equilibrium.balance.residual(equilibrium.values)
    assert np.linalg.norm(model.constraint.free.T @ forces) <= model.settings.tolerance * size


def test_another_start_leads_to_the_same_equilibrium(model):
    q = np.array([6.0, 2.0])
    cold = model.solve(MODULI, q)
    other = model.solve(np.array([3.0, 4.0]), 0.7 * q)
    warm = model.solve(MODULI, q, start=other.displacement, nearby=other.factorisation)
    assert np.allclose(warm.values, cold.values, atol=1e-6)
    assert warm.counts.factorisations == 0


def test_the_linear_model_lends_start_and_factorisation(model):
    system = linear_model(model.space, model.constraint, dilatation=Dilatation.BLENDED).system(MODULI)
    q = np.array([4.0, 2.0])
    linear = system.solve(q)
    found = model.solve(MODULI, q, start=linear.displacement, nearby=system.factorisation)
    assert found.counts.factorisations == 0
    assert np.allclose(found.values, model.solve(MODULI, q).values, atol=1e-6)


def test_stiffnesses_of_both_laws_have_one_pattern(meshes):
    """The solver's plan is of the pattern. Cubes have entries that are zero under the linear law alone."""
    mesh = meshes.box_mesh(3, size=30.0, tissues=[meshes.known("fat", nu=0.45), meshes.unknown("organ", nu=0.4)])
    space = lagrange_space(mesh, "P2")
    constraint = outer_constraint(space, outer="fixed", **meshes.prescribe(space, np.zeros(0, int), np.zeros((0, 3))))
    system = linear_model(space, constraint, dilatation=Dilatation.BLENDED).system(MODULI)
    model = finite_strain_model(space, constraint, LAWS["neo-hookean"])
    balance = model.balance(MODULI)
    linear, finite = system.factorisation.matrix, balance.restricted(balance.stiffness(np.sin(space.points.ravel())))
    assert np.any(linear.data == 0.0)
    assert np.array_equal(linear.indptr, finite.indptr)
    assert np.array_equal(linear.indices, finite.indices)


def test_a_stiffness_serves_again_where_it_would_do_once_more(model, monkeypatch):
    """Beside an equilibrium the corrections need no other than the first step's; from far each has its own."""
    q, made, assemble = np.array([6.0, 2.0]), [0], TissueBalance.stiffness

    def counted(*of, **named):
        made[0] += 1
        return assemble(*of, **named)

    monkeypatch.setattr(TissueBalance, "stiffness", counted)
    far = model.solve(MODULI, q)
    from_far, made[0] = made[0], 0
    near = model.solve(MODULI, 1.01 * q, start=far.displacement, nearby=far.factorisation)
    assert far.path.iterations - far.path.steps >= from_far - far.path.steps > 1
    assert made[0] < near.path.iterations
    forces, size = near.balance.residual(near.values)
    assert np.linalg.norm(model.constraint.free.T @ forces) <= model.settings.tolerance * size


def test_derivatives_by_poissons_ratio_are_those_of_the_solution(meshes):
    model = finite_strain_model(
        *meshes.pushed_block(n=2), LAWS["mooney-rivlin"], settings=NewtonSettings(tolerance=1e-12)
    )
    q, step = np.array([5.0, 2.0]), 1e-5
    equilibrium = model.solve(MODULI, q)
    tangents = equilibrium.poisson_tangents()
    for region in range(2):
        shift = step * np.eye(2)[region]
        ahead, behind = (
            replace(model, poisson_ratios=model.poisson_ratios + s * shift).solve(MODULI, q).values for s in (1, -1)
        )
        expected = (ahead - behind) / (2.0 * step)
        assert np.allclose(tangents[:, region], expected, atol=1e-6 * abs(expected).max())


def test_where_an_element_is_turned_inside_out_nothing_bounds_the_error(model):
    """A first-order expansion followed too far ends there; its error is told, not an energy that does not exist."""
    equilibrium = model.solve(MODULI, np.array([5.0, 2.0])).refactorised()
    near, far = (equilibrium.values + share * equilibrium.tangent()[:, 2] for share in (0.01, 50.0))
    assert equilibrium.balance.smallest_volume(far) < 0.0
    assert 0.0 < equilibrium.error_estimate(MODULI, equilibrium.coefficients, near)[0] < 0.1
    assert equilibrium.error_estimate(MODULI, equilibrium.coefficients, far)[0] == np.inf


def test_an_exact_factorisation_changes_the_price_and_not_the_tangent(model):
    equilibrium = model.solve(MODULI, np.array([5.0, 2.0]))
    exact = equilibrium.refactorised()
    assert exact.tangent_counts.factorisations == 0
    assert np.allclose(exact.tangent(), equilibrium.tangent(), atol=1e-9)


@pytest.mark.parametrize("solver", SOLVERS)
@pytest.mark.parametrize("dilatation", Dilatation)
def test_no_solver_changes_equilibrium_or_tangent(meshes, solver, dilatation):
    space, constraint = meshes.pushed_block(n=2)
    found = []
    for name in ("multifrontal", solver):
        settings = NewtonSettings(tolerance=1e-11, solver=name)
        model = finite_strain_model(space, constraint, LAWS["neo-hookean"], dilatation=dilatation, settings=settings)
        found.append(model.solve(MODULI, np.array([5.0, 2.0])))
    assert np.allclose(found[1].values, found[0].values, atol=1e-8)
    assert np.allclose(found[1].tangent(), found[0].tangent(), atol=1e-8)


def test_derivatives_along_directions_need_no_factorisation(model):
    """From those of another state, with its factorisation: to a hundredth of what was lacking."""
    there = model.solve(np.array([1.4, 2.2]), np.array([4.0, 1.0]))
    here = model.solve(MODULI, np.array([5.0, 2.0]), start=there.displacement, nearby=there.factorisation)
    directions = np.random.default_rng(5).standard_normal((4, 3))
    guess, expected = there.tangent() @ directions, here.tangent() @ directions
    lacking = np.linalg.norm(expected - guess, axis=0)
    found = here.tangent_along(directions, guess)
    assert np.all(np.linalg.norm(found - expected, axis=0) < 0.03 * lacking)
    assert np.allclose(here.tangent_along(directions, expected), expected, atol=1e-9)


def test_other_modes_of_the_same_points_need_no_new_model(model):
    constraint = replace(model.constraint, modes=model.constraint.modes[:, :1], offset=model.constraint.modes[:, 1])
    found = model.with_conditions(Conditions(constraint)).solve(MODULI, np.array([3.0])).values
    assert np.allclose(found, model.solve(MODULI, np.array([3.0, 1.0])).values, atol=1e-8)


def test_a_constraint_that_frees_other_points_is_refused(model, meshes):
    _, constraint = meshes.pushed_block(outer="sliding")
    with pytest.raises(ConfigurationError, match="other free displacements"):
        model.with_conditions(Conditions(constraint))


def test_a_motion_beyond_the_body_ends_in_a_sentence_at_a_sound_state(model):
    """The floor pushed by three times the height of the block, through its roof."""
    settings = NewtonSettings(smallest_step=0.05, max_steps=8)
    reached = replace(model, settings=settings).attempt(MODULI, np.array([100.0, 0.0]))
    assert not reached.converged
    assert 0.0 <= reached.fraction < 1.0
    assert np.all(np.isfinite(reached.values))
    assert reached.balance.smallest_volume(reached.values) > 0.0
    assert "% of the motion and load (step" in reached.reason
    with pytest.raises(NotConverged, match="has no derivatives"):
        reached.tangent()


def test_solve_raises_what_attempt_reports(model):
    hasty = replace(model, settings=NewtonSettings(max_steps=1, max_iterations=1))
    with pytest.raises(NotConverged, match=r"tetrahedron \d+ of '(fat|organ)' at"):
        hasty.solve(MODULI, np.array([10.0, 0.0]))


def test_a_start_of_another_space_is_refused(model):
    with pytest.raises(ConfigurationError, match="the start has the shape"):
        model.solve(MODULI, np.zeros(2), start=np.zeros((4, 3)))


def test_a_body_at_rest_that_nothing_moves_stays_there(model):
    lent = model.solve(MODULI, np.array([1.0, 0.0])).factorisation
    for nearby in (None, lent):
        assert not model.solve(MODULI, np.zeros(2), nearby=nearby).values.any()


@pytest.mark.parametrize("law", FINITE)
@pytest.mark.parametrize("nu", [0.45, 0.4999])
def test_a_tube_of_12_mm_is_filled_by_10_mm(meshes, law, nu):
    """In plane strain and nearly incompressible, the outside follows: b^2 = B^2 + a^2 - A^2."""
    mesh = meshes.quarter_ring_mesh(12.0, 40.0, 6, 8, meshes.known("tube", nu=nu))
    space = lagrange_space(mesh, "P2")
    held = np.abs(space.points) < 1e-9
    held[:, 2] = True
    bore = mesh.boundary[np.all(np.hypot(*mesh.nodes[mesh.boundary][:, :, :2].transpose(2, 0, 1)) < 12.01, axis=1)]
    points = np.unique(space.facets(bore))
    held[points, :2] = True
    values = np.zeros_like(space.points)
    values[points, :2] = 10.0 / 12.0 * space.points[points, :2]
    model = finite_strain_model(space, meshes.held_components(held, values), LAWS[law])
    equilibrium = model.solve(np.array([10.0]), np.zeros(0))
    assert equilibrium.balance.smallest_volume(equilibrium.values) > 0.3
    if nu == 0.4999:
        radius = np.hypot(*mesh.nodes[:, :2].T)
        moved = np.hypot(*(mesh.nodes + equilibrium.displacement[: len(mesh.nodes)])[:, :2].T)
        outside = np.abs(radius - 40.0) < 1e-9
        assert moved[outside].mean() == pytest.approx(np.sqrt(40.0**2 + 22.0**2 - 12.0**2), rel=2e-3)


def test_newton_converges_quadratically(meshes):
    """B15's point: with the exact tangent each iteration squares the error."""
    model = finite_strain_model(*meshes.pushed_block(n=2), LAWS["neo-hookean"])
    q = np.array([6.0, 3.0])
    exact = replace(model, settings=NewtonSettings(tolerance=1e-13)).solve(MODULI, q).values
    balance, free = model.balance(MODULI), model.constraint.free
    u = exact + free @ np.asarray(free.T @ (0.05 * np.sin(np.arange(len(exact)))))
    errors = []
    for _ in range(4):
        errors.append(np.linalg.norm(u - exact))
        K, residual = balance.stiffness(u), balance.residual(u)[0]
        u = u - free @ balance.factorise(K).solve((free.T @ residual)[:, None])[:, 0]
    errors = np.array(errors)
    assert np.all(errors[1:3] < errors[:2] ** 2)
    assert errors[3] < 1e-8 * errors[0]
