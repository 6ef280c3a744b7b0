"""Image pairs that agree, and one that does not: outliers, influence, heterogeneity, repeatability."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from palpate.inversion import Objective, gauss_newton, invert
from palpate.observation.noise_model import NoiseModel
from palpate.uncertainty import NORMAL_95, mesh_covariance, sandwich_covariance
from palpate.uncertainty.image_pairs import PairEstimates, agreement, pair_estimates

COVARIANCE = np.array([[0.04, 0.01], [0.01, 0.02]])
TRUTH = np.log([3.0, 2.0])


def of(theta, *, shared=0.0):
    """Pairs whose estimates have the same covariance each, of which a part is `shared`."""
    n = len(theta)
    alike = (1.0 - shared) * np.eye(n) + shared
    covariance = np.einsum("pq,ij->piqj", alike, COVARIANCE)
    return PairEstimates(np.asarray(theta), covariance, np.ones(n, dtype=bool))


def drawn(rng, n, *, between=0.0, shared=0.0):
    """Pairs whose moduli scatter by their own covariance, and from pair to pair by `between` more."""
    own, one = rng.multivariate_normal(np.zeros(2), COVARIANCE, n), rng.multivariate_normal(np.zeros(2), COVARIANCE)
    errors = np.sqrt(1.0 - shared) * own + np.sqrt(shared) * one
    return of(TRUTH + errors + between * rng.standard_normal((n, 2)), shared=shared)


@pytest.fixture(scope="module", params=[0.0, 0.5])
def agreeing(request):
    """600 cases of four pairs that have the same moduli, their errors independent or half in common."""
    rng = np.random.default_rng(20240511)
    return [agreement(drawn(rng, 4, shared=request.param)) for _ in range(600)]


def test_among_pairs_that_agree_an_outlier_and_a_difference_are_as_rare_as_stated(agreeing):
    assert np.mean([each.outlier.any() for each in agreeing]) < 0.025
    assert 0.02 < np.mean([each.heterogeneity < 0.05 for each in agreeing]) < 0.09


def test_the_interval_of_the_mean_holds_the_truth_as_often_as_it_says(agreeing):
    off = np.array([np.abs(each.theta - TRUTH) / np.sqrt(np.diag(each.covariance)) for each in agreeing])
    assert np.mean(off < NORMAL_95) == pytest.approx(0.95, abs=0.025)


def test_where_pairs_truly_differ_the_interval_of_their_mean_holds_that_of_all_that_there_could_be(rng):
    found = [agreement(drawn(rng, 6, between=0.4)) for _ in range(300)]
    off = np.array([np.abs(each.theta - TRUTH) / np.sqrt(np.diag(each.covariance)) for each in found])
    assert np.mean(off < NORMAL_95) > 0.88
    assert np.mean([each.heterogeneity < 0.05 for each in found]) > 0.8


def test_a_spoilt_pair_is_found_and_the_mean_of_the_rest_is_as_good_as_without_it(rng):
    errors, others, alone = [], [], []
    for _ in range(200):
        theta = drawn(rng, 4).theta
        spoilt = theta + np.outer(np.arange(4) == 2, [1.5, -1.2])
        found = agreement(of(spoilt))
        alone.append(found.outlier.tolist() == [False, False, True, False])
        if not alone[-1]:
            continue
        errors.append(found.theta - TRUTH)
        others.append(agreement(of(theta[[0, 1, 3]])).theta - TRUTH)
    assert np.mean(alone) > 0.96
    assert np.sqrt(np.mean(np.square(errors))) < 1.2 * np.sqrt(np.mean(np.square(others)))


def test_the_influence_of_a_pair_is_how_far_the_mean_moves_without_it(rng):
    found = agreement(of(drawn(rng, 5).theta + np.outer(np.arange(5) == 1, [0.6, 0.0])))
    assert int(np.abs(found.influence[:, 0]).argmax()) == 1
    assert found.influence[1, 0] > 0.0


def test_moduli_that_change_from_pair_to_pair_are_heterogeneous_and_widen_the_mean(rng):
    alike, changing = ([agreement(drawn(rng, 8, between=by)) for _ in range(50)] for by in (0.0, 0.3))
    assert np.median([each.heterogeneity for each in changing]) < 0.01
    assert 0.3 < np.median([each.heterogeneity for each in alike]) < 0.7
    wide, narrow = (np.median([np.diag(each.covariance) for each in of], axis=0) for of in (changing, alike))
    assert np.all(wide > 2.0 * narrow)


def test_of_two_pairs_none_is_called_an_outlier():
    found = agreement(of([TRUTH, TRUTH + 3.0]))
    assert not found.outlier.any()
    assert found.heterogeneity < 1e-6


@pytest.fixture(scope="module")
def joint(twins, twin):
    """Two motions of one body, through noise."""
    problem = twins.exact_problem(
        twin, twins.deformed(twin.model, seed=8), noise=NoiseModel(np.array([0.1**2]), np.array([3.0]))
    )
    settings = twins.settings(1.0)
    return invert(problem, settings, progress=twins.silent), settings.bounds


def errors_of(evaluation, rng=None, size=0.0):
    """Of 8 draws, independent ones of a `size` in mm."""
    rng = rng or np.random.default_rng(0)
    return [[size * rng.standard_normal(len(line.weights)) for line in evaluation.linearisations] for _ in range(8)]


@pytest.fixture(scope="module")
def by_first(joint):
    """The pairs of the joint estimate, both with the rest image of the first one."""
    return alone(joint)


def alone(joint, *, reference=0, **changes):
    """The pairs of the joint estimate, with the rest image of the second one its own (1) or that of the first (0)."""
    inversion, bounds = joint
    first, second = inversion.objective.states
    objective = replace(inversion.objective, states=(first, replace(second, reference=reference)), **changes)
    return pair_estimates(objective, inversion.minimum, bounds, errors_of(inversion.minimum.evaluation))


def test_every_pair_says_alone_what_it_says_and_their_mean_is_near_the_joint_estimate(joint, by_first):
    (inversion, _), found = joint, by_first
    assert found.converged.tolist() == [True, True]
    together = agreement(found)
    sd = np.sqrt(np.diag(sandwich_covariance(inversion.objective, inversion.minimum.evaluation)))
    assert np.all(np.abs(together.theta - inversion.minimum.unknowns[:2]) < 0.3 * sd)
    assert np.all(np.diag(found.covariance[0, :, 0]) > sd**2)
    assert not together.outlier.any()


def test_the_covariance_of_a_pair_is_that_of_an_estimate_from_it_alone(joint, by_first):
    """By noise and prior as the sandwich has it, and by the mesh."""
    (inversion, bounds), found = joint, by_first
    parameters, own = inversion.objective.parameters.alone(0)
    single = Objective(inversion.objective.states[:1], parameters)
    start = inversion.minimum.unknowns[own]
    minimum = gauss_newton(single, start, bounds=bounds)
    expected = sandwich_covariance(single, minimum.evaluation) + mesh_covariance(single)
    assert found.covariance[0, :, 0] == pytest.approx(expected, rel=0.1)


def test_pairs_of_one_rest_image_err_together_and_of_two_they_do_not(joint, by_first):
    one, two = by_first, alone(joint, reference=1)
    assert np.all(np.diag(one.covariance[0, :, 1]) > 0.1 * np.diag(one.covariance[0, :, 0]))
    assert two.covariance[0, :, 1] == pytest.approx(np.zeros((2, 2)), abs=1e-9)
    whole = one.covariance.reshape(4, 4)
    assert whole == pytest.approx(whole.T)
    assert np.linalg.eigvalsh(whole).min() > 0.0


def test_what_was_believed_of_the_moduli_counts_once_however_many_pairs_there_are(joint):
    """Where images tell next to nothing beside it, the mean of two is as uncertain as the belief."""
    inversion, _ = joint
    parameters = inversion.objective.parameters.with_prior(inversion.minimum.unknowns[:2], np.full(2, 1e-3))
    found = alone(joint, reference=1, parameters=parameters)
    mesh = np.diag(
        [mesh_covariance(replace(inversion.objective, states=(s,)))[0, 0] for s in inversion.objective.states]
    )
    believed = found.covariance[:, 0, :, 0] - mesh
    assert np.sqrt(believed) == pytest.approx(np.full((2, 2), 1e-3), rel=0.05)


def test_the_place_of_the_grid_counts_in_every_pair(joint, rng):
    inversion, bounds = joint
    evaluation = inversion.minimum.evaluation
    without, with_it = (
        pair_estimates(inversion.objective, inversion.minimum, bounds, errors_of(evaluation, rng, size))
        for size in (0.0, 10.0)
    )
    added = with_it.covariance - without.covariance
    assert np.all(np.einsum("pipi->pi", added) > 0.5 * np.einsum("pipi->pi", without.covariance))
    assert np.linalg.eigvalsh(with_it.covariance.reshape(4, 4)).min() > 0.0
