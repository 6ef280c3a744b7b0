"""Finite strain from the linear estimate: the moduli of the law that deformed the body."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from palpate.inversion.continuation import continued_at_finite_strain
from palpate.inversion.directions import deciding_directions
from palpate.inversion.invert import invert

from palpate.inversion import continuation
from palpate.mechanics.finite_strain import finite_strain_model
from palpate.mechanics.laws.registry import law_named


@pytest.fixture(scope="module")
def body(twins):
    """A twin whose truth is neo-Hookean, its exact problem and its finite-strain model."""
    twin = twins.make_twin(element="P1", seed=8)
    space, constraint = twin.model.space, twin.model.constraint
    model = finite_strain_model(space, constraint, law_named("neo-hookean"))
    truth = model.solve(twin.moduli, 0.7 * twin.coefficients).displacement
    scene = replace(twin.scene, displacement=truth)
    moved = replace(twin, scene=scene, coefficients=0.7 * twin.coefficients)
    return moved, twins.exact_problem(moved), model


@pytest.fixture(scope="module")
def linear(twins, body):
    return invert(body[1], twins.settings(0.5, 8.0), progress=twins.silent)


@pytest.fixture(scope="module", params=[0, 1000], ids=["those that decide", "all"])
def continued(request, twins, body, linear):
    """With the derivatives that decide the moduli made those of each equilibrium, or all of them."""
    _, problem, model = body
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(continuation, "FEW", request.param)
        return continued_at_finite_strain(
            replace(problem, finite_strain=(model,)), linear, twins.settings(0.5, 8.0), progress=twins.silent
        )


def test_the_law_that_made_the_data_finds_the_moduli(twins, linear, continued):
    assert np.abs(linear.minimum.unknowns[:2] - twins.TRUTH).max() > 0.03  # or there would be nothing to show
    assert continued.minimum.outcome.converged
    assert continued.settled
    assert np.abs(continued.minimum.unknowns[:2] - twins.TRUTH).max() < 1e-3


def test_the_derivatives_that_decide_the_moduli_are_those_of_the_equilibrium(body, continued):
    """The other columns may be those of an earlier one."""
    objective, unknowns = continued.objective, continued.minimum.unknowns
    there = body[2].solve(objective.modulus_map.moduli(unknowns[:2]), unknowns[2:])
    directions = deciding_directions(objective, continued.minimum.evaluation)[0]
    exact, stated = there.tangent() @ directions, continued.surrogates[0].reduced.derivatives @ directions
    assert np.linalg.norm(stated - exact, axis=0) == pytest.approx(0.0, abs=0.02 * np.linalg.norm(exact))


def test_the_displacement_reported_is_an_equilibrium(body, continued):
    model = body[2]
    objective, unknowns = continued.objective, continued.minimum.unknowns
    moduli = objective.modulus_map.moduli(unknowns[:2])
    stated = continued.surrogates[0].reduced.solve(moduli, unknowns[2:]).displacement
    assert stated == pytest.approx(model.solve(moduli, unknowns[2:]).displacement, abs=1e-5)


def test_every_start_carries_its_whole_history(linear, continued):
    for before, after in zip(linear.minima, continued.minima, strict=True):
        assert after.history[: len(before.history)] == before.history
