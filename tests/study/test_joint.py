"""Several later images and several moduli together, as a result states them."""

from __future__ import annotations

import numpy as np
import pytest

from palpate.inversion import fixed_correspondence, invert
from palpate.observation.noise_model import NoiseModel
from palpate.statement.estimate_findings import pair_findings
from palpate.statement.image_pairs import ImagePairs, PairAlone, image_pairs_of
from palpate.statement.joint import combinations_of, regions_of
from palpate.statement.stated_posterior import StatedPosterior
from palpate.uncertainty import Covariance, StatedMixture, sandwich_covariance

NOISE = NoiseModel(np.array([0.1**2]), np.array([3.0]))


@pytest.fixture(scope="module")
def settings(twins):
    return twins.settings(2.0)


@pytest.fixture(scope="module")
def both(twins, settings):
    """Two motions of one body."""
    problem = twins.exact_problem(*(twins.make_twin(seed=seed) for seed in (5, 8)), noise=NOISE)
    return invert(problem, settings, progress=twins.silent)


@pytest.fixture(scope="module")
def single(twins, twin, settings):
    return invert(twins.exact_problem(twin, noise=NOISE), settings, progress=twins.silent)


def posterior_of(inversion, covariance):
    """One explanation, that of the minimum, with a covariance (2, 2) of the log-moduli."""
    minimum, zero = inversion.minimum, np.zeros((2, 2))
    fixed = fixed_correspondence(inversion.objective, minimum.unknowns, minimum.evaluation)
    alone = np.ones(1), minimum.unknowns[None, :2], covariance[None]
    return StatedPosterior(fixed, minimum, StatedMixture(*alone, Covariance(covariance, zero, zero, zero, covariance)))


def no_errors(inversion):
    return [[np.zeros(len(line.weights)) for line in inversion.minimum.evaluation.linearisations]] * 8


def test_later_images_are_stated_in_kpa_each_alone(both, settings):
    found = image_pairs_of(both, settings.bounds, no_errors(both))
    assert len(found.alone) == 2
    assert [set(pair.noise_mm) for pair in found.alone] == [{"surface distance"}] * 2
    for pair in found.alone:
        low, high = pair.interval95["gland"]
        assert low < 30.0 < high
        assert low < pair.moduli["gland"] < high
    low, high = found.mean_interval95["gland"]
    assert high / low < min(pair.interval95["gland"][1] / pair.interval95["gland"][0] for pair in found.alone)
    assert pair_findings(found) == ()
    left = found.with_intervals_of({"sac"})
    assert [set(of) for of in (left.mean_interval95, *(pair.interval95 for pair in left.alone))] == [{"sac"}] * 3


def test_one_later_image_has_no_other_to_agree_with(single, settings):
    assert image_pairs_of(single, settings.bounds, no_errors(single)) is None
    assert pair_findings(None) == ()


def test_a_mean_is_in_kpa_and_a_ratio_has_no_unit(single, settings):
    wide = np.array([[1.0, -0.995], [-0.995, 1.0]])
    (mean,) = combinations_of(single, posterior_of(single, wide), settings.bounds, within=2.0)
    (ratio,) = combinations_of(single, posterior_of(single, np.abs(wide)), settings.bounds, within=2.0)
    assert (mean.kind, mean.value) == ("geometric mean", pytest.approx(np.sqrt(30.0 * 20.0), rel=0.05))
    assert (ratio.kind, ratio.value) == ("ratio", pytest.approx(1.5, rel=0.1))


def test_an_image_that_contradicts_the_others_is_named_with_what_they_say():
    noise = {"surface distance": 0.3}
    alone = [
        PairAlone({"p": 30.0}, {"p": (27.0, 33.0)}, number == 1, {"p": 4.0 * number}, noise) for number in range(3)
    ]
    first, second = pair_findings(ImagePairs(tuple(alone), 1e-4, {"p": 0.1}, {"p": 31.0}, {"p": (29.0, 33.0)}))
    assert (first.code, second.code) == ("pair-outlier", "heterogeneous")
    assert "'after[2]' contradicts" in first.message
    assert "'p' by +4.0 standard deviations (31 without it)" in first.message


@pytest.mark.parametrize(("noises", "named"), [((0.3, 0.4, 0.9), 1), ((0.3, 0.4, 0.45), 0), ((0.3, 0.9), 0)])
def test_an_image_whose_surfaces_fit_far_worse_is_named(noises, named):
    """One of three at the least: of two that differ nobody can say which is the usual one."""
    alone = [PairAlone({"p": 30.0}, {"p": (27.0, 33.0)}, False, {"p": 0.1}, {"surface distance": sd}) for sd in noises]
    found = pair_findings(ImagePairs(tuple(alone), 0.5, {"p": 0.1}, {"p": 31.0}, {"p": (29.0, 33.0)}))
    assert [finding.code for finding in found] == ["pair-noise"] * named
    assert all("'after[3]' fits worse" in finding.message for finding in found)
    assert all("0.9 mm instead of 0.35 mm" in finding.message for finding in found)


def test_a_region_is_stated_in_kpa_around_the_estimate_of_both(single, settings):
    objective, minimum = single.objective, single.minimum
    covariance = sandwich_covariance(objective, minimum.evaluation)
    posterior = posterior_of(single, covariance)
    assert regions_of(single, posterior, settings.bounds, tissues={"gland"}) == ()
    (region,) = regions_of(single, posterior, settings.bounds, tissues={"gland", "sac"})
    assert region.tissues == objective.parameters.tissues
    assert not region.open
    estimate = objective.parameters.scale_kpa * np.exp(minimum.unknowns[:2])
    half = np.exp(2.4477 * np.sqrt(np.diag(covariance)))
    for edge in (region.boundary, region.ellipse):
        low, high = np.min(edge, axis=0), np.max(edge, axis=0)
        assert np.all((low < estimate) & (estimate < high))
        assert high / estimate == pytest.approx(half, rel=0.15)
