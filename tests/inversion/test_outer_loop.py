"""An estimate is where weights and moduli agree: not where one way to it or one saving happens to end."""

from __future__ import annotations

from dataclasses import replace
from itertools import count

import numpy as np
import pytest
from palpate.inversion.agreement import AGREED, agreed, left_since
from palpate.inversion.gauss_newton import gauss_newton
from palpate.inversion.invert import TO_REPORT, invert
from palpate.inversion.weighting import weighed_anew

from palpate.inversion import agreement
from palpate.mechanics.first_order import expanded

SAME = 1e-3  # of ln E: two ways, each to AGREED


@pytest.fixture(scope="module")
def found(twins, voxels):
    return invert(voxels, twins.settings(0.5), progress=twins.silent)


def change(one, other):
    return np.abs(one.minimum.unknowns[:2] - other.minimum.unknowns[:2]).max()


@pytest.mark.parametrize("ratio", [1.0, 3.0, 20.0])
def test_the_way_to_the_estimate_does_not_show(twins, voxels, found, ratio):
    assert change(invert(voxels, twins.settings(ratio), progress=twins.silent), found) < SAME


def test_another_pass_changes_nothing(twins, voxels, found):
    assert agreed(voxels, found.objective, found.minimum, twins.settings(0.5), passes=1).change < AGREED


def test_weights_that_never_agree_are_not_called_settled(twins, voxels, monkeypatch):
    """Three sets of weights in turn: a round of three passes ends where it began, and still nothing has settled."""
    passes = count()

    def in_turn(problem, objective, minimum, law=None):
        law, weighed = weighed_anew(problem, objective, minimum, law)
        times = (1.0, 9.0, 81.0)[next(passes) % 3]
        first = [[replace(w, precision=times * w.precision), *others] for w, *others in weighed.weighting]
        return law, replace(weighed, weighting=tuple(map(tuple, first)))

    monkeypatch.setattr(agreement, "weighed_anew", in_turn)
    monkeypatch.setattr("palpate.inversion.invert.TO_REPORT", replace(TO_REPORT, passes=3))
    assert not invert(voxels, twins.settings(0.5), progress=twins.silent).settled


def test_the_full_model_finds_the_same_where_the_reduced_one_stands(twins, twin, voxels, found):
    """All derivatives of the full model exact, under the weights of the estimate."""
    moduli = voxels.modulus_map.moduli(found.minimum.unknowns[:2])
    amounts = found.minimum.unknowns[2:]
    full = expanded(twin.model.solve(moduli, amounts), names=twin.model.names, moduli=moduli, coefficients=amounts)
    bounds = twins.settings(0.5).bounds
    end = gauss_newton(found.objective.under([full]), found.minimum.unknowns, bounds=bounds, still=1e-5)
    assert np.abs(end.unknowns[:2] - found.minimum.unknowns[:2]).max() < AGREED


def test_derivatives_that_are_exact_nowhere_leave_everything_open(found):
    assert left_since(None, found.minimum, 2) == np.inf
    assert left_since(found.minimum.unknowns[:2], found.minimum, 2) == 0.0
    sd = np.sqrt(np.diag(np.linalg.inv(found.minimum.evaluation.matrix))[:2])
    assert left_since(found.minimum.unknowns[:2] - [0.1, 0.0], found.minimum, 2) == pytest.approx(
        0.1 * max(sd[0], 0.03)
    )
