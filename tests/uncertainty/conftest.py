"""Fixtures of the tests of uncertainty; their twin problems stand in the conftest of all tests."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from palpate.mechanics.first_order import expanded


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
