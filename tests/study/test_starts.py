"""Starts: those of the case, and some that are spread over the bounds of all moduli, not along their diagonal alone."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from palpate.body.refusals import refuse_what_cannot_be_estimated
from palpate.case.case import Estimate
from palpate.errors import ConfigurationError
from palpate.study.run import FURTHER, inversion_settings


def settings_of(n, **options):
    parameters = SimpleNamespace(scale_kpa=10.0, tissues=("a", "b", "c")[:n], poisson=())
    return inversion_settings(SimpleNamespace(estimate=Estimate(**options)), parameters)


@pytest.mark.parametrize("n", [1, 2, 3])
def test_further_starts_lie_within_the_bounds_and_off_the_diagonal(n):
    settings = settings_of(n)
    further, low, high = np.array(settings.further), settings.bounds.lower, settings.bounds.upper
    assert further.shape == (FURTHER, n)
    assert np.all((further > low) & (further < high))
    quarters = np.floor(4.0 * (further - low) / (high - low)).astype(int)
    assert [sorted(set(of)) for of in quarters.T] == [[0, 1, 2, 3]] * n  # each modulus alone over all of its range
    if n > 1:
        assert len({tuple(start < 0.5 * (low + high)) for start in further}) == 2**n  # every corner of the box
    assert settings.every_start == (*settings.starts, *settings.further)


def test_the_starts_of_the_case_stay_and_the_middle_one_is_theirs():
    settings = settings_of(2, start_ratios=(0.5, 2.0, 8.0))
    assert np.exp(np.array(settings.starts)) == pytest.approx(np.array([[0.5] * 2, [2.0] * 2, [8.0] * 2]))


def test_lbfgs_is_refused_with_what_to_write():
    case = SimpleNamespace(images=None, estimate=Estimate(method="lbfgs"))
    with pytest.raises(ConfigurationError, match="gauss-newton"):
        refuse_what_cannot_be_estimated(case)
