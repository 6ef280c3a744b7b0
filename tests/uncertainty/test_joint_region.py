"""The joint region of two moduli: an ellipse where the model is straight, else with the profiles for its shadows."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import pytest

from palpate.errors import SolverError
from palpate.inversion import Bounds, MarginalPosterior, fixed_correspondence
from palpate.uncertainty.profile import DIRECTIONS, JOINT_LEVEL, joint_region, profile

WIDE = Bounds(np.full(2, np.log(0.02)), np.full(2, np.log(200.0)))


@pytest.fixture(scope="module")
def fixed(objective, minimum):
    return MarginalPosterior.of(fixed_correspondence(objective, minimum.unknowns, minimum.evaluation))


@pytest.fixture(scope="module")
def covariance(minimum):
    return minimum.evaluation.covariance_columns(2)[:2]


@pytest.fixture(scope="module")
def region(fixed, minimum, covariance):
    return joint_region(fixed, minimum, (0, 1), covariance=covariance, bounds=WIDE)


def test_the_ellipse_is_that_of_the_covariance(region, minimum, covariance):
    centre = region.ellipse.mean(axis=0)
    away = region.ellipse - centre
    assert np.all(np.abs(centre - minimum.unknowns[:2]) < 0.02 * np.sqrt(np.diag(covariance)))
    assert np.einsum("na,ab,nb->n", away, np.linalg.inv(covariance), away) == pytest.approx(
        [JOINT_LEVEL**2] * DIRECTIONS
    )
    assert pytest.approx(5.991, abs=1e-3) == JOINT_LEVEL**2


def test_where_the_model_is_straight_the_region_is_the_ellipse(objective, minimum, covariance, straight):
    fixed = MarginalPosterior.of(
        fixed_correspondence(straight(objective, minimum), minimum.unknowns, minimum.evaluation)
    )
    found = joint_region(fixed, minimum, (0, 1), covariance=covariance, bounds=WIDE)
    assert np.abs((found.boundary - found.ellipse) / np.sqrt(np.diag(covariance))).max() < 0.02 * JOINT_LEVEL
    assert not found.open


def test_the_shadow_of_the_region_is_the_profile_at_its_level(region, fixed, minimum, covariance):
    """The largest value of a modulus in the region is where its own profile has the same deviance."""
    for i in range(2):
        alone = profile(fixed, minimum, i, variance=covariance[i, i], bounds=WIDE, level=JOINT_LEVEL)
        half = JOINT_LEVEL * np.sqrt(covariance[i, i])
        assert region.boundary[:, i].max() == pytest.approx(alone.high, abs=0.12 * half)
        assert region.boundary[:, i].min() == pytest.approx(alone.low, abs=0.12 * half)
        assert abs(alone.high + alone.low - 2.0 * minimum.unknowns[i]) > 0.03 * half  # it leans


def test_bounds_cut_the_region_and_it_says_so(fixed, minimum, covariance, region):
    upper = minimum.unknowns[:2] + 0.5 * JOINT_LEVEL * np.sqrt(np.diag(covariance))
    cut = joint_region(fixed, minimum, (0, 1), covariance=covariance, bounds=Bounds(WIDE.lower, upper))
    assert cut.open
    assert not region.open
    assert np.all(cut.boundary <= upper + 1e-9)
    assert cut.boundary[:, 0].min() == pytest.approx(region.boundary[:, 0].min(), abs=0.05)


def test_the_order_of_the_two_is_that_of_the_columns(fixed, minimum, covariance, region):
    other = joint_region(fixed, minimum, (1, 0), covariance=covariance[::-1, ::-1], bounds=WIDE)
    assert other.boundary.max(axis=0) == pytest.approx(region.boundary.max(axis=0)[::-1], abs=0.08)


@dataclass(frozen=True)
class Brittle:
    """An objective that is solved no further than so many standard deviations from a place."""

    of: object
    place: np.ndarray
    reach: np.ndarray

    @property
    def n_parameters(self):
        return self.of.n_parameters

    def __call__(self, unknowns):
        if np.any(np.abs(unknowns[:2] - self.place) > self.reach):
            raise SolverError("too far")
        return self.of(unknowns)


def test_a_region_that_cannot_be_followed_is_open(fixed, minimum, covariance):
    of = Brittle(fixed.objective, minimum.unknowns[:2], 1.5 * np.sqrt(np.diag(covariance)))
    found = joint_region(replace(fixed, objective=of), minimum, (0, 1), covariance=covariance, bounds=WIDE)
    assert found.open
    assert np.all(np.abs(found.boundary - minimum.unknowns[:2]) <= of.reach + 1e-9)
