"""Fixtures of the tests of uncertainty; their twin problems stand in the conftest of all tests."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from palpate.inversion import Bounds, gauss_newton
from palpate.mechanics.first_order import expanded
from palpate.observation.noise_model import NoiseModel

WIDE = Bounds(np.full(2, np.log(0.02)), np.full(2, np.log(200.0)))
WEAK = NoiseModel(np.array([0.18**2]), np.array([3.0]))


@pytest.fixture(scope="session")
def objective(twins, twin):
    """With so much noise that the moduli are known to a factor of two at the most."""
    return twins.objective_of(twins.exact_problem(twin, noise=WEAK), twin.coefficients).rematched(twin.unknowns)


@pytest.fixture(scope="session")
def minimum(objective, twin):
    return gauss_newton(objective, twin.unknowns, bounds=WIDE, tolerance=1e-8)


@pytest.fixture
def rng():
    return np.random.default_rng(20240511)


@pytest.fixture(scope="session")
def straight():
    """An objective with every state's model to first order around a minimum."""

    def of(objective, minimum):
        mapping, states = objective.parameters, []
        moduli = mapping.moduli(minimum.unknowns)
        for state, q in zip(objective.states, mapping.coefficients(minimum.unknowns), strict=True):
            names = state.model.names
            there = expanded(state.observed.solve(moduli, q), names=names, moduli=moduli, coefficients=q)
            states.append(replace(state, observed=there))
        return replace(objective, states=tuple(states))

    return of
