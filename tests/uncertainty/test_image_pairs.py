"""Image pairs that agree, and one that does not: outliers, influence, heterogeneity, repeatability."""

from __future__ import annotations

import numpy as np
import pytest

from palpate.inversion import invert
from palpate.observation.noise_model import NoiseModel
from palpate.uncertainty import sandwich_covariance
from palpate.uncertainty.image_pairs import PairEstimate, agreement, pair_estimates

COVARIANCE = np.array([[0.04, 0.01], [0.01, 0.02]])
TRUTH = np.log([3.0, 2.0])


def drawn(rng, n, between=0.0):
    """Pairs whose moduli scatter by their own covariance, and from pair to pair by `between` more."""
    truths = TRUTH + between * rng.standard_normal((n, 2))
    return [PairEstimate(t, COVARIANCE, True) for t in (rng.multivariate_normal(t, COVARIANCE) for t in truths)]


def test_among_pairs_that_agree_an_outlier_is_as_rare_as_stated(rng):
    found = [agreement(drawn(rng, 4)) for _ in range(600)]
    share = np.mean([each.outlier.any() for each in found])
    assert share < 0.025
    assert 0.02 < np.mean([each.heterogeneity < 0.05 for each in found]) < 0.09


def test_a_spoilt_pair_is_found_and_the_mean_of_the_rest_is_as_good_as_without_it(rng):
    errors, others = [], []
    for _ in range(200):
        pairs = drawn(rng, 4)
        spoilt = PairEstimate(pairs[2].theta + np.array([1.5, -1.2]), COVARIANCE, True)
        found = agreement([*pairs[:2], spoilt, pairs[3]])
        assert np.array_equal(found.outlier, [False, False, True, False])
        errors.append(found.theta - TRUTH)
        others.append(agreement([*pairs[:2], pairs[3]]).theta - TRUTH)
    assert np.sqrt(np.mean(np.square(errors))) < 1.2 * np.sqrt(np.mean(np.square(others)))


def test_the_influence_of_a_pair_is_how_far_the_mean_moves_without_it(rng):
    pairs = drawn(rng, 5)
    pairs[1] = PairEstimate(pairs[1].theta + np.array([0.6, 0.0]), COVARIANCE, True)
    found = agreement(pairs)
    assert int(np.abs(found.influence[:, 0]).argmax()) == 1
    assert found.influence[1, 0] > 0.0


def test_moduli_that_change_from_pair_to_pair_are_heterogeneous_and_widen_the_mean(rng):
    alike, changing = agreement(drawn(rng, 8)), agreement(drawn(rng, 8, between=0.6))
    assert changing.heterogeneity < 1e-3 < alike.heterogeneity
    assert np.all(np.diag(changing.covariance) > 2.0 * np.diag(alike.covariance))


def test_of_two_pairs_none_is_called_an_outlier():
    far = [PairEstimate(TRUTH, COVARIANCE, True), PairEstimate(TRUTH + 3.0, COVARIANCE, True)]
    found = agreement(far)
    assert not found.outlier.any()
    assert found.heterogeneity < 1e-6


def test_the_variation_within_a_patient_is_standard_deviation_over_mean_of_its_moduli(rng):
    wide = [PairEstimate(TRUTH + 0.6 * rng.standard_normal(2), COVARIANCE, True) for _ in range(4000)]
    moduli = np.exp([pair.theta for pair in wide])
    assert agreement(wide).within_cv == pytest.approx(moduli.std(axis=0) / moduli.mean(axis=0), rel=0.1)


@pytest.fixture(scope="module")
def joint(twins):
    """Two motions of one body, through noise."""
    both = [twins.make_twin(seed=seed) for seed in (5, 8)]
    problem = twins.exact_problem(*both, noise=NoiseModel(np.array([0.1**2]), np.array([3.0])))
    settings = twins.settings(1.0)
    return invert(problem, settings, progress=twins.silent), settings.bounds


def test_every_pair_says_alone_what_it_says_and_their_mean_is_near_the_joint_estimate(joint):
    inversion, bounds = joint
    alone = pair_estimates(inversion.objective, inversion.minimum, bounds)
    assert [pair.converged for pair in alone] == [True, True]
    together = agreement(alone)
    sd = np.sqrt(np.diag(sandwich_covariance(inversion.objective, inversion.minimum.evaluation)))
    assert np.all(np.abs(together.theta - inversion.minimum.unknowns[:2]) < 0.3 * sd)
    assert np.all(np.diag(alone[0].covariance) > sd**2)
    assert not together.outlier.any()
