"""Intervals end where the search ended, and the verdict follows from their width."""

from __future__ import annotations

import numpy as np
import pytest
from palpate.inversion.verdict import hull, log_interval, verdict


def test_the_interval_is_symmetric_in_the_logarithm():
    low, high = log_interval(3.0, 0.2, lower=0.02, upper=200.0)
    assert np.log(high / 3.0) == pytest.approx(1.96 * 0.2, rel=1e-4)
    assert low * high == pytest.approx(9.0)


@pytest.mark.parametrize(
    ("centre", "open_low", "open_high"), [(0.05, True, False), (100.0, False, True), (2.0, False, False)]
)
def test_an_end_beyond_the_bounds_is_open(centre, open_low, open_high):
    low, high = log_interval(centre, 0.5, lower=0.02, upper=200.0)
    assert (low is None, high is None) == (open_low, open_high)


@pytest.mark.parametrize(
    ("interval", "absolute", "word"),
    [
        ((1.0, 2.0), True, "identified"),
        ((1.0, 2.01), True, "weak"),
        ((1.0, 10.0), True, "weak"),
        ((1.0, 10.1), True, "not identified"),
        ((None, 2.0), True, "not identified"),
        ((1.0, None), True, "not identified"),
        ((1.0, 1.5), False, "ratio only"),
        ((1.0, 5.0), False, "ratio only"),
        ((1.0, 11.0), False, "not identified"),
        ((None, 1.5), False, "not identified"),
    ],
)
def test_the_verdict_follows_from_the_width_of_the_interval(interval, absolute, word):
    assert verdict(interval, at_bound=False, absolute=absolute)[0] == word


def test_an_estimate_at_its_bound_is_not_identified_however_narrow():
    word, why = verdict((1.0, 1.1), at_bound=True, absolute=True)
    assert word == "not identified"
    assert "bound" in why


def test_every_verdict_states_its_figure():
    for interval in ((1.0, 1.5), (1.0, 4.0), (1.0, 20.0)):
        assert f"{interval[1]:.1f}" in verdict(interval, at_bound=False, absolute=True)[1]


def test_the_hull_holds_every_interval_and_an_open_end_stays_open():
    assert hull([(2.0, 4.0), (1.0, 3.0)]) == (1.0, 4.0)
    assert hull([(2.0, 4.0), (None, 3.0)]) == (None, 4.0)
    assert hull([(2.0, None)]) == (2.0, None)
