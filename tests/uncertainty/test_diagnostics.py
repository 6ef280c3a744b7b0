"""Chains that have mixed are told from those that have not."""

from __future__ import annotations

import numpy as np
import pytest

from palpate.uncertainty import chain_diagnostics


def test_independent_draws_have_mixed_and_count_in_full(rng):
    found = chain_diagnostics(rng.standard_normal((4, 1000, 3)))
    assert found.r_hat == pytest.approx(np.ones(3), abs=0.005)
    assert found.ess_bulk == pytest.approx(np.full(3, 4000.0), rel=0.2)
    assert found.ess_tail == pytest.approx(np.full(3, 4000.0), rel=0.2)
    assert found.mixed.all()


def test_draws_that_hang_together_count_as_the_closed_form_of_their_correlation_has_it(rng):
    """x' = a x + sqrt(1 - a^2) xi: n draws are worth n (1 - a) / (1 + a)."""
    a, steps = 0.6, rng.standard_normal((4, 4000))
    chains = np.empty_like(steps)
    chains[:, 0] = steps[:, 0]
    for k in range(1, steps.shape[1]):
        chains[:, k] = a * chains[:, k - 1] + np.sqrt(1.0 - a**2) * steps[:, k]
    found = chain_diagnostics(chains[..., None])
    assert found.ess_bulk[0] == pytest.approx(16000.0 * (1.0 - a) / (1.0 + a), rel=0.15)
    assert found.mixed.all()


def test_chains_that_stay_apart_and_chains_that_are_short_have_not_mixed(rng):
    apart = rng.standard_normal((4, 500, 1)) + 3.0 * np.arange(4)[:, None, None]
    found = chain_diagnostics(apart)
    assert found.r_hat[0] > 1.5
    assert found.ess_bulk[0] < 20.0
    assert not found.mixed[0]
    assert not chain_diagnostics(rng.standard_normal((4, 50, 1))).mixed[0]


def test_chains_that_never_moved_have_not_mixed():
    found = chain_diagnostics(np.ones((4, 100, 1)))
    assert np.isnan(found.r_hat[0])
    assert not found.mixed[0]
