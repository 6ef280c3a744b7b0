"""Finite strain from the linear estimate: the moduli of the law that deformed the body."""

from __future__ import annotations

from dataclasses import fields, replace
from functools import cache

import numpy as np
import pytest

from palpate.approximation import expansion
from palpate.errors import EstimationError, NotConverged, SolverError
from palpate.inversion import Candidate, Outcome, concluded, continuation, invert
from palpate.inversion.trust_region import NEAR, REPORTED
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
    _, problem, model = body
    found = invert(problem.linear(), settings, progress=twins.silent, rule=NEAR)
    candidates = [replace(candidate, iterate=under(model, candidate.iterate)) for candidate in found.candidates]
    return replace(found, candidates=tuple(candidates))


def followed(linear, bounds, progress=silent):
    """What comes of linear minima."""
    minima = [candidate.iterate for candidate in linear.candidates]
    ends = continuation.continued(minima, bounds, rule=REPORTED, progress=progress)
    return concluded(ends, linear.starts, linear.rest, bounds)


def under(model, iterate):
    """A linear minimum whose state has that finite-strain model."""
    states = tuple(replace(state, finite_strain=model) for state in iterate.objective.states)
    return replace(iterate, objective=replace(iterate.objective, states=states))


def failing(model, error):
    """A finite-strain model that has no equilibrium anywhere, for that reason."""

    class Failing(FiniteStrainModel):
        def attempt(self, *_, **__):
            raise error

        solve = attempt

    return Failing(*(getattr(model, field.name) for field in fields(model)))


@pytest.fixture(scope="module")
def ended(linear, settings):
    """The estimate where all derivatives are made those of each equilibrium up to so many of them."""

    @cache
    def with_few(few):
        with pytest.MonkeyPatch.context() as patch:
            around = continuation.expansion_around
            patch.setattr(continuation, "expansion_around", lambda *of, **named: replace(around(*of, **named), few=few))
            return followed(linear, settings.bounds)

    return with_few


@pytest.fixture(scope="module", params=[0, 1000], ids=["those that decide", "all"])
def continued(request, ended):
    """With the derivatives that decide the moduli made those of each equilibrium, or all of them."""
    return ended(request.param)


def split(inversion):
    """Moduli and coefficients of the estimate, and its approximation."""
    unknowns, parameters = inversion.minimum.unknowns, inversion.objective.parameters
    return parameters.moduli(unknowns), unknowns[2:], inversion.objective.states[0].approximation


def test_the_law_that_made_the_data_finds_the_moduli(twins, linear, continued):
    assert np.abs(linear.minimum.unknowns[:2] - twins.TRUTH).max() > 0.03  # or there would be nothing to show
    assert continued.minimum.converged
    assert continued.convergence.converged
    assert np.abs(continued.minimum.unknowns[:2] - twins.TRUTH).max() < 1e-3


def test_the_derivatives_that_decide_the_moduli_are_those_of_the_equilibrium(body, continued):
    """The other columns may be those of an earlier one."""
    moduli, q, approximation = split(continued)
    there = body[2].solve(moduli, q)
    directions = continued.objective.linearisation_points(continued.minimum.unknowns, continued.minimum.evaluation)[
        0
    ].directions
    exact, stated = there.tangent() @ directions, approximation.model.derivatives @ directions
    assert np.linalg.norm(stated - exact, axis=0) == pytest.approx(0.0, abs=0.02 * np.linalg.norm(exact))


def test_all_derivatives_are_those_of_the_equilibrium_where_they_are_few(ended):
    """By the directions that decide alone columns of elsewhere remain."""
    found, missed = ended(0), []
    unknowns = found.minimum.unknowns + np.array([0.3, -0.2, *np.full(len(found.minimum.unknowns) - 2, 0.1)])
    evaluation = found.objective(unknowns)
    for few in (0, expansion.FEW):
        (place,) = found.objective.linearisation_points(unknowns, evaluation)
        there = replace(found.objective.states[0].approximation, few=few).update(place)
        exact = there.equilibrium.tangent()
        missed.append(np.linalg.norm(there.model.derivatives - exact) / np.linalg.norm(exact))
    assert missed[1] < 0.02  # of what they lack a hundredth is left, see `tangent_along`
    assert missed[0] > 3.0 * missed[1]


def test_the_displacement_reported_is_an_equilibrium(body, continued):
    moduli, q, _ = split(continued)
    stated = continued.objective.states[0].displacement(moduli, q)
    assert stated == pytest.approx(body[2].solve(moduli, q).displacement, abs=1e-5)


def test_every_start_keeps_the_steps_and_the_verdict_that_it_had_under_the_linear_law(linear, continued):
    for before, after in zip(linear.starts, continued.starts, strict=True):
        assert after.minimum.history == before.minimum.history
        assert after.minimum.outcome is before.minimum.outcome
        assert np.array_equal(after.theta, before.theta)


def test_the_steps_that_the_starts_share_are_those_of_both_laws_and_lead_to_the_estimate(linear, continued):
    history = continued.minimum.history
    assert len(history) > len(linear.minimum.history) > 0
    assert history[: len(linear.minimum.history)] == linear.minimum.history
    assert np.abs(history[-1].theta - continued.minimum.unknowns[:2]).max() < 1e-3


def test_what_both_laws_cost_is_counted(linear, continued):
    assert continued.counts.forward > linear.counts.forward
    assert continued.counts.factorisations > linear.counts.factorisations
    assert continued.evaluations > linear.evaluations


def test_a_motion_without_equilibrium_ends_the_estimate_where_it_is_the_best_one(body, linear, settings):
    best = linear.candidates[linear.best]
    lost = replace(best, iterate=under(failing(body[2], NotConverged("folded")), best.iterate))
    with pytest.raises(NotConverged, match="folded"):
        followed(replace(linear, candidates=(lost,)), settings.bounds)


FAILURES = {
    NotConverged("folded"): Outcome.NO_EQUILIBRIUM,
    SolverError("singular"): Outcome.NOT_FOLLOWED,
    EstimationError("nothing left to compare"): Outcome.NOT_FOLLOWED,
}


def test_secondary_minima_that_fail_do_not_end_a_good_estimate(twins, body, linear, settings):
    """They are left out of the comparison, and it is said why."""
    first = linear.candidates[0]
    rest = np.zeros(len(first.minimum.unknowns) - 1)
    others = []
    for by, error in zip((1.0, 2.0, -1.0), FAILURES, strict=True):
        away = replace(first.minimum, unknowns=first.minimum.unknowns + np.append(by, rest))
        iterate = under(failing(body[2], error), replace(first.iterate, minimum=away))
        others.append(Candidate(iterate, first.value))
    starts = (linear.starts[0], *(replace(linear.starts[1], candidate=k) for k in (1, 2, 3)))
    said = list[str]()
    several = replace(linear, candidates=(first, *others), starts=starts)
    found = followed(several, settings.bounds, progress=said.append)
    assert all(any(str(failure) in line for line in said) for failure in FAILURES)
    assert found.minimum.converged
    assert np.abs(found.minimum.unknowns[:2] - twins.TRUTH).max() < 1e-3
    assert [c.minimum.outcome for c in found.candidates[1:]] == list(FAILURES.values())
    assert [start.candidate for start in found.starts] == [0, 1, 2, 3]


def test_starts_that_merge_under_the_law_of_the_case_are_one_candidate(twins, linear, settings):
    """Two linear minima, from which the law of the case leads to the same moduli."""
    first = linear.candidates[0]
    away = first.minimum.unknowns + np.append(0.2, np.zeros(len(first.minimum.unknowns) - 1))
    elsewhere = replace(first.iterate, minimum=replace(first.minimum, unknowns=away))
    starts = (linear.starts[0], replace(linear.starts[1], candidate=1))
    both = replace(linear, candidates=(first, Candidate(elsewhere, first.value + 1.0)), starts=starts)
    found = followed(both, settings.bounds)
    assert len(found.candidates) == 1
    assert [start.candidate for start in found.starts] == [0, 0]
    assert np.abs(found.minimum.unknowns[:2] - twins.TRUTH).max() < 1e-3
