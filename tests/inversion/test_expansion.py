"""Finite strain from the linear estimate: the moduli of the law that deformed the body."""

from __future__ import annotations

from dataclasses import fields, replace

import numpy as np
import pytest

from palpate.approximation import expansion
from palpate.errors import EstimationError, NotConverged, SolverError
from palpate.inversion import REPORTED, begun, invert, searched
from palpate.inversion.estimate import at_finite_strain
from palpate.inversion.search import ROUGH
from palpate.mechanics.finite_strain import FiniteStrainModel, finite_strain_model
from palpate.mechanics.laws.registry import law_named
from palpate.progress import silent


@pytest.fixture(scope="module")
def body(twins):
    """A twin whose truth is neo-Hookean, its exact problem and its finite-strain model."""
    twin = twins.make_twin(element="P1", seed=8)
    space, constraint = twin.model.space, twin.model.constraint
    model = finite_strain_model(space, constraint, law_named("neo-hookean"))
    truth = model.solve(twin.moduli, 0.7 * twin.coefficients).displacement
    scene = replace(twin.scene, displacement=truth)
    moved = replace(twin, scene=scene, coefficients=0.7 * twin.coefficients)
    problem = twins.exact_problem(moved)
    states = tuple(replace(state, finite_strain=model) for state in problem.states)
    return moved, replace(problem, states=states), model


@pytest.fixture(scope="module")
def settings(twins):
    return twins.settings(0.5, 8.0)


@pytest.fixture(scope="module")
def linear(twins, body, settings):
    """What the finite-strain law is begun from."""
    return invert(body[1].linear(), settings, progress=twins.silent, rule=ROUGH)


@pytest.fixture(scope="module")
def continued(twins, body, settings):
    return invert(body[1], settings, progress=twins.silent)


def failing(model, error):
    """A finite-strain model that has no equilibrium anywhere, for that reason."""

    class Failing(FiniteStrainModel):
        def attempt(self, *_, **__):
            raise error

        solve = attempt

    return Failing(*(getattr(model, field.name) for field in fields(model)))


def split(inversion):
    """Moduli and coefficients of the estimate, and its approximation."""
    unknowns, parameters = inversion.minimum.unknowns, inversion.objective.parameters
    return parameters.moduli(unknowns), unknowns[2:], inversion.objective.states[0].approximation


def test_the_law_that_made_the_data_finds_the_moduli(twins, linear, continued):
    assert np.abs(linear.minimum.unknowns[:2] - twins.TRUTH).max() > 0.03  # or there would be nothing to show
    assert continued.minimum.converged
    assert np.abs(continued.minimum.unknowns[:2] - twins.TRUTH).max() < 1e-3


@pytest.fixture(scope="module", params=[0, expansion.FEW], ids=["those that decide", "all"])
def ended(request, twins, settings, continued):
    """Where a search goes on to whose derivatives are made exact: up to so many of them all."""
    (approximation,) = continued.objective.approximations
    start = begun(
        continued.objective.with_approximations([replace(approximation, few=request.param)]), continued.minimum.unknowns
    )
    return searched(start, settings.bounds, REPORTED, progress=twins.silent, title="")


def test_the_derivatives_that_decide_the_moduli_are_those_of_the_equilibrium(twins, body, ended):
    """The other columns may be those of an earlier one."""
    end = ended
    assert end.minimum.converged
    assert np.abs(end.minimum.unknowns[:2] - twins.TRUTH).max() < 1e-3
    moduli, q, approximation = split(end)
    (point,) = end.objective.linearisation_points(end.minimum.unknowns, [end.minimum.evaluation])
    exact = body[2].solve(moduli, q).tangent() @ point.directions
    stated = approximation.model.derivatives @ point.directions
    assert np.linalg.norm(stated - exact, axis=0) == pytest.approx(0.0, abs=0.02 * np.linalg.norm(exact))


def test_all_derivatives_are_those_of_the_equilibrium_where_they_are_few(continued):
    """By the directions that decide alone columns of elsewhere remain."""
    found, missed = continued, []
    unknowns = found.minimum.unknowns + np.array([0.3, -0.2, *np.full(len(found.minimum.unknowns) - 2, 0.1)])
    evaluation = found.objective(unknowns)
    for few in (0, expansion.FEW):
        (place,) = found.objective.linearisation_points(unknowns, [evaluation])
        there = replace(found.objective.states[0].approximation, few=few).update(place)
        exact = there.equilibrium.tangent()
        missed.append(np.linalg.norm(there.model.derivatives - exact) / np.linalg.norm(exact))
    assert missed[1] < 0.02  # of what they lack a hundredth is left, see `tangent_along`
    assert missed[0] > 3.0 * missed[1]


def test_the_displacement_reported_is_an_equilibrium(body, continued):
    moduli, q, _ = split(continued)
    stated = continued.objective.states[0].displacement(moduli, q)
    assert stated == pytest.approx(body[2].solve(moduli, q).displacement, abs=1e-5)


def test_starts_are_those_of_the_linear_law(linear, continued):
    for before, after in zip(linear.starts, continued.starts, strict=True):
        assert np.array_equal(after.theta, before.theta)
        assert after.minimum.outcome is before.minimum.outcome
        assert np.array_equal(after.minimum.unknowns, before.minimum.unknowns)


def test_the_steps_that_the_starts_share_are_those_of_both_laws_and_lead_to_the_estimate(linear, continued):
    history = continued.minimum.history
    assert len(history) > len(linear.minimum.history) > 0
    thetas = [[tuple(iterate.theta) for iterate in found.minimum.history] for found in (linear, continued)]
    assert thetas[1][: len(thetas[0])] == thetas[0]
    assert np.abs(history[-1].theta - continued.minimum.unknowns[:2]).max() < 1e-3


def test_what_both_laws_cost_is_counted(linear, continued):
    assert continued.counts.forward > linear.counts.forward
    assert continued.counts.factorisations > linear.counts.factorisations
    assert continued.evaluations > linear.evaluations


@pytest.mark.parametrize(
    "error", [NotConverged("folded"), SolverError("singular"), EstimationError("nothing left")], ids=str
)
def test_a_motion_without_equilibrium_ends_the_estimate_and_says_why(twins, body, settings, error):
    _, problem, model = body
    states = tuple(replace(state, finite_strain=failing(model, error)) for state in problem.states)
    with pytest.raises(type(error), match=str(error)):
        invert(replace(problem, states=states), settings, progress=twins.silent)


def test_it_goes_on_where_the_linear_law_has_led(twins, body):
    """To the same unknowns, under the same prior, with the equilibrium there."""
    _, problem, model = body
    objective = twins.objective_of(problem, body[0].coefficients)
    start = begun(objective, body[0].unknowns)
    near = at_finite_strain(start, progress=silent)
    moduli, q, approximation = split(near)
    assert np.array_equal(near.minimum.unknowns, start.minimum.unknowns)
    assert near.objective.parameters is start.objective.parameters
    assert not near.settled
    exact = model.solve(moduli, q).values
    assert np.abs(approximation.model.solve(moduli, q).values - exact).max() < 1e-3
