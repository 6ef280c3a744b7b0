"""States that go to equilibrium side by side end where each ends alone."""

from __future__ import annotations

import numpy as np
import pytest

from palpate.mechanics.chord import chord_equilibria
from palpate.mechanics.dilatation import Dilatation
from palpate.mechanics.finite_strain import finite_strain_model
from palpate.mechanics.laws.registry import LAWS
from palpate.mechanics.linear_model import linear_model

MODULI = np.array([3.0, 12.0])
MOTIONS = np.array([[1.0, 0.5], [-2.0, 1.0], [4.0, 2.0]])
FAR = np.array([60.0, 0.0])  # the floor pushed through the roof


@pytest.fixture(scope="module")
def models(meshes):
    """Of a block of 30 mm whose floor is pushed up (mode 0) and aside (mode 1): linear, and at finite strain."""
    space, constraint = meshes.pushed_block()
    dilatation = Dilatation.BLENDED
    finite = finite_strain_model(space, constraint, LAWS["neo-hookean"], dilatation=dilatation)
    return linear_model(space, constraint, dilatation=dilatation), finite


def ends(models, motions, *, iterations):
    linear, finite = models
    system = linear.system(MODULI)
    starts = [system.solve(q).values for q in motions]
    balances = [finite.balance(MODULI)] * len(starts)
    return chord_equilibria(balances, starts, system.factorisation, tolerance=1e-8, iterations=iterations)


def test_each_state_ends_at_its_own_equilibrium(models):
    for q, found in zip(MOTIONS, ends(models, MOTIONS, iterations=60), strict=True):
        expected = models[1].solve(MODULI, q).values
        assert found == pytest.approx(expected, abs=1e-6 * np.abs(expected).max())


def test_a_state_without_an_end_leaves_the_others_theirs(models):
    first, none = ends(models, [MOTIONS[0], FAR], iterations=60)
    assert none is None
    assert first == pytest.approx(ends(models, MOTIONS[:1], iterations=60)[0], abs=1e-7)


def test_too_few_iterations_lead_nowhere(models):
    assert ends(models, MOTIONS[2:], iterations=1) == [None]
