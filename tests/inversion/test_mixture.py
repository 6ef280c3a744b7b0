"""The posterior over explanations of numbers that were read: that of the whole normal law, computed directly."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from palpate.inversion import (
    Bounds,
    Candidates,
    Objective,
    cheapest_posterior,
    gauss_newton,
    mixture_of,
)
from palpate.inversion.linear_evidence import SEEN, TRUSTED_SD, LinearEvidence
from palpate.observation.robust_loss import PowerLaw
from palpate.unknowns.blocks import Choice

EVERY = Candidates(most=10_000)  # more explanations than there are
FRAME, GLAND, SAC = 4, 5, 6  # numbers of the first image's blocks
AWAY = np.array([0.2, 0.1])


@pytest.fixture(scope="module", params=[(0, 1), (1, 1), (2, 2)], ids=str)
def seen(request, patients):
    """A patient with so many later images and an objective of what was read in them."""
    seed, n_images = request.param
    rng = np.random.default_rng(seed)
    of = patients.patient(rng, n_images)
    return of, of.objective(rng)


def place(of, theta=AWAY):
    """All unknowns somewhere, by their number."""
    return np.concatenate([theta, 0.1 * np.cos(np.arange(of.parameters.n_coefficients))])


def compared(of, objective, candidates=EVERY):
    x = place(of)
    return LinearEvidence.of(objective.parameters, objective(x), x).compared(candidates)


def mixture_at(objective, unknowns, bounds=None, **named):
    evaluation = objective(unknowns)
    posterior = cheapest_posterior(objective, unknowns, evaluation)
    bounds = bounds or Bounds(np.full(2, -4.0), np.full(2, 4.0))
    return mixture_of(posterior, unknowns, evaluation, bounds, **named)


def dense(patients, of, objective, **named):
    """Log-evidence with log prior odds of every explanation, by its choices."""
    read = patients.seen_in(objective)
    return {
        tuple(sorted(chosen)): odds + patients.dense_evidence(of, read, chosen, **named)
        for chosen, odds in patients.every_explanation(of.parameters)
    }


@pytest.fixture(scope="module")
def trusted(patients, seen):
    """The dense evidences where ln E is trusted round where residuals were made linear."""
    return dense(patients, *seen, theta=AWAY, theta_sd=TRUSTED_SD)


def test_linear_evidence_is_that_of_the_normal_law_of_all_readings(seen, trusted):
    """Where residuals were made linear does not matter, but by how far ln E is trusted round it."""
    (of, objective), every = seen, trusted
    found = compared(of, objective)
    levels = np.array([each.evidence - each.several for each in found])
    expected = np.array([every[tuple(sorted(each.chosen))] for each in found])
    assert levels - levels[0] == pytest.approx(expected - expected[0], abs=1e-6)
    assert expected[0] == pytest.approx(max(every.values()), abs=1e-9)


def test_all_explanations_of_one_image_are_compared_and_the_likely_ones_of_several(seen, trusted):
    (of, objective), every = seen, trusted
    best = max(every.values())
    found = {tuple(sorted(each.chosen)) for each in compared(of, objective)}
    near = {chosen for chosen, level in every.items() if level > best - SEEN}

    def with_layers(chosen):
        return [k for i, k in chosen if of.parameters.blocks[i].choice is Choice.LAYERS]

    for chosen in found - near:  # the likeliest with layers, or without: its minimum may be far away
        assert every[chosen] == max(
            level for other, level in every.items() if with_layers(other) == with_layers(chosen)
        )
    if of.parameters.n_states == 1:
        assert found >= near
    shares = {chosen: np.exp(level - best) for chosen, level in every.items()}
    assert sum(shares[chosen] for chosen in found) > 0.97 * sum(shares.values())


def test_what_combinations_of_images_add_is_counted(patients):
    """The total of the compared ones is that of all, where no unknown that images share stands between them."""
    rng = np.random.default_rng(5)
    of = patients.without(patients.patient(rng, 2, seldom=-0.5), (0, 1, 2, 3))
    objective = of.objective(rng)
    every = np.array(list(dense(patients, of, objective, theta=AWAY, theta_sd=TRUSTED_SD).values()))
    found = compared(of, objective)
    first = max(every)
    total = np.log(np.sum(np.exp(every - first)))
    own = np.log(np.sum(np.exp([each.evidence - (found[0].evidence - found[0].several) for each in found])))
    assert total > 0.05  # or there would be nothing to show
    assert own == pytest.approx(total, abs=0.02 + np.exp(-SEEN) * len(every))


def test_each_explanation_comes_with_its_minimum(seen):
    of, objective = seen
    x = place(of)
    for each in compared(of, objective)[:4]:
        there = objective.with_prior(objective.parameters.choosing(dict(each.chosen)))(each.unknowns)
        trusted = np.zeros(len(x))
        trusted[:2] = TRUSTED_SD**-2.0 * (each.unknowns[:2] - AWAY)
        assert np.abs(there.score + trusted).max() < 1e-6 * np.abs(objective(x).score).max()


def test_weights_are_those_of_the_exact_evidences(patients, seen):
    """Ln E flat; Laplace's approximation is exact for a linear body."""
    of, objective = seen
    every = dense(patients, of, objective)
    mixture = mixture_at(objective, place(of), candidates=EVERY)
    found = np.log(mixture.weights)
    expected = np.array([every[tuple(sorted(each.chosen.items()))] for each in mixture.explanations])
    assert len(found) > 2
    assert np.all(np.diff(found) <= 0.0)
    assert found.max() - found == pytest.approx(expected.max() - expected, abs=0.01 if len(of.bodies) == 1 else 0.05)


def test_every_component_is_the_exact_posterior_of_its_explanation(patients, seen):
    of, objective = seen
    design, read = of.design(), np.concatenate(patients.seen_in(objective))
    for each in mixture_at(objective, place(of)).explanations[:4]:
        prior = of.parameters.choosing(each.chosen).prior_matrix.dense
        whole = np.linalg.inv(design.T @ design / patients.SD**2 + prior)
        assert each.covariance == pytest.approx(whole[:2, :2], rel=1e-6)
        sd = np.sqrt(np.diag(whole[:2, :2]))
        mean = (whole @ design.T @ read / patients.SD**2)[:2]
        assert np.all(np.abs(each.theta - mean) < 0.05 * sd)


def test_its_moments_are_those_of_draws(seen):
    of, objective = seen
    mixture = mixture_at(objective, place(of))
    rng = np.random.default_rng(0)
    counts = rng.multinomial(200_000, mixture.weights)
    draws = np.concatenate(
        [rng.multivariate_normal(e.theta, e.covariance, n) for e, n in zip(mixture.explanations, counts, strict=True)]
    )
    sd = np.sqrt(np.diag(mixture.covariance))
    assert mixture.weights.sum() == pytest.approx(1.0)
    assert np.all(np.abs(draws.mean(axis=0) - mixture.mean) < 0.01 * sd)
    assert np.cov(draws.T) == pytest.approx(mixture.covariance, abs=0.02 * sd.max() ** 2)


@pytest.mark.parametrize("shift", [-1.0, 0.7])
def test_prior_odds_shift_log_weights_by_themselves(patients, shift):
    found = []
    for odds in (0.0, shift):
        rng = np.random.default_rng(1)
        of = patients.with_unknowns(patients.patient(rng, odds=odds), 0, [0.3, -0.3])
        mixture = mixture_at(of.objective(rng), place(of))
        found.append({tuple(sorted(e.chosen.items())): np.log(e.weight) for e in mixture.explanations})
    shared = [chosen for chosen in found[0] if chosen in found[1]]
    moved = np.array([found[1][chosen] - found[0][chosen] for chosen in shared])
    patchy = np.array([dict(chosen)[0] == 1 for chosen in shared])
    assert 0 < patchy.sum() < len(shared)
    assert moved[patchy].mean() - moved[~patchy].mean() == pytest.approx(shift, abs=1e-6)
    assert np.ptp(moved[patchy]) < 1e-6
    assert np.ptp(moved[~patchy]) < 1e-6


CAUSES = {
    "the frame stands still": ({}, {FRAME: 0, GLAND: 0, SAC: 0}),
    "the frame hardly moves": ({FRAME: [0.25, -0.3]}, {FRAME: 1, GLAND: 0, SAC: 0}),
    "the frame moves": ({FRAME: [1.5, -2.0]}, {FRAME: 2, GLAND: 0, SAC: 0}),
    "the sac is drawn otherwise": ({SAC: [0.8]}, {FRAME: 0, GLAND: 0, SAC: 1}),
    "both are drawn otherwise": ({GLAND: [-0.8], SAC: [0.8]}, {FRAME: 0, GLAND: 1, SAC: 1}),
    "tissues are very patchy": ({0: [0.9, -0.8], 1: [1.0, 0.7]}, {0: 2, 1: 2, 2: 0, 3: 0}),
    "there are layers": ({2: [-2.0], 3: [1.8]}, {0: 0, 1: 0, 2: 1, 3: 1}),
}


@pytest.mark.parametrize("cause", CAUSES)
@pytest.mark.parametrize("seed", range(3))
def test_what_made_the_readings_gets_most_weight(patients, cause, seed):
    rng = np.random.default_rng(seed)
    of = patients.patient(rng)
    values, expected = CAUSES[cause]
    for block, unknowns in values.items():
        of = patients.with_unknowns(of, block, unknowns)
    (first, *_) = mixture_at(of.objective(rng), place(of)).explanations
    assert {block: first.chosen[block] for block in expected} == expected
    assert first.weight > 0.4


@pytest.mark.parametrize(
    "dropped", [(4,), (5, 6), (4, 5, 6), (0, 1), (2, 3), (0, 1, 2, 3), (0, 1, 2, 3, 4, 5)], ids=str
)
def test_choices_that_a_problem_lacks_are_none(patients, dropped):
    rng = np.random.default_rng(2)
    of = patients.without(patients.patient(rng), dropped)
    objective = of.objective(rng)
    every = dense(patients, of, objective)
    mixture = mixture_at(objective, place(of), candidates=EVERY)
    expected = np.array([every[tuple(sorted(each.chosen.items()))] for each in mixture.explanations])
    assert np.log(mixture.weights) - np.log(mixture.weights[0]) == pytest.approx(expected - expected[0], abs=0.01)


def test_a_block_that_is_held_stays_so_under_every_explanation(patients):
    rng = np.random.default_rng(2)
    of = patients.patient(rng)
    blocks = list(of.parameters.blocks)
    blocks[SAC] = replace(blocks[SAC], alternatives=blocks[SAC].alternatives[1:], choice=Choice.HELD)
    parameters = replace(of.parameters, blocks=tuple(blocks), priors=())
    objective = replace(of, parameters=parameters).objective(rng)
    mixture = mixture_at(objective, place(of, theta=np.zeros(2)))
    assert all(SAC not in each.chosen for each in mixture.explanations)
    assert abs(mixture.minimum.unknowns[-1]) < 1e-6


def test_two_images_tell_more_than_each(patients):
    rng = np.random.default_rng(6)
    of = patients.patient(rng, 2)
    both = of.objective(rng)
    together = mixture_at(both, place(of)).covariance
    for s in range(2):
        parameters, own = of.parameters.alone(s)
        alone = Objective((both.states[s],), parameters)
        covariance = mixture_at(alone, place(of)[own]).covariance
        assert np.all(np.linalg.eigvalsh(covariance - together) > 0.0)


def test_the_order_of_images_does_not_matter(patients):
    rng = np.random.default_rng(7)
    of = patients.with_unknowns(patients.patient(rng, 3), FRAME, [1.0, 1.4])
    problem = of.problem(rng)
    found = []
    for order in ((0, 1, 2), (2, 0, 1)):
        again = patients.reordered(problem, order)
        objective = Objective(again.states, again.parameters)
        found.append(mixture_at(objective, np.zeros(of.parameters.n_unknowns)))
    one, other = found
    assert other.weights == pytest.approx(one.weights, rel=1e-3)
    assert other.mean == pytest.approx(one.mean, abs=1e-3 * np.sqrt(np.diag(one.covariance)).min())
    assert other.covariance == pytest.approx(one.covariance, rel=1e-3)
    assert [other.explanations[0].images[i] for i in (1, 2, 0)] == list(one.explanations[0].images)


@pytest.mark.parametrize("unit", [2.0, 0.1])
@pytest.mark.parametrize("of_what", ["readings", "frame"])
def test_another_unit_changes_nothing(patients, unit, of_what):
    found = []
    for k in (1.0, unit):
        rng = np.random.default_rng(8)
        of = patients.patient(rng, 2, unit=k if of_what == "frame" else 1.0)
        of = patients.with_unknowns(of, FRAME, np.array([1.0, -1.0]) / (k if of_what == "frame" else 1.0))
        own = k if of_what == "readings" else 1.0
        sd = own * patients.SD
        objective = patients.in_unit(of, own).objective(rng, bounds=(sd, sd), scale=own)
        found.append(mixture_at(objective, np.zeros(of.parameters.n_unknowns)))
    one, other = found
    assert other.weights == pytest.approx(one.weights, rel=1e-5)
    assert other.mean == pytest.approx(one.mean, abs=1e-7)
    assert other.covariance == pytest.approx(one.covariance, rel=1e-6)


def test_intervals_are_calibrated(patients):
    """Of truths drawn as is believed, the mean square of errors over posterior standard deviations is 1."""
    rng, squares = np.random.default_rng(9), []
    for _ in range(40):
        of = patients.patient(rng)
        choices, odds = zip(*patients.every_explanation(of.parameters), strict=True)
        shares = np.exp(odds) / np.sum(np.exp(odds))
        chosen = dict(choices[rng.choice(len(shares), p=shares)])
        for block, k in chosen.items():
            covariance = of.parameters.blocks[block].alternatives[k].covariance
            drawn = np.sqrt(np.diag(covariance)) * rng.standard_normal(len(covariance))
            of = patients.with_unknowns(of, block, drawn)
        mixture = mixture_at(of.objective(rng), np.concatenate([of.truth[:2], np.zeros(len(of.truth) - 2)]))
        squares += list((mixture.mean - of.truth[:2]) ** 2 / np.diag(mixture.covariance))
    assert np.mean(squares) == pytest.approx(1.0, abs=3.0 * np.sqrt(2.0 / len(squares)))


def test_bounds_hold_every_explanation(patients):
    rng = np.random.default_rng(10)
    of = patients.patient(rng)
    bounds = Bounds(np.full(2, -0.1), np.full(2, 0.1))
    mixture = mixture_at(of.objective(rng), np.zeros(of.parameters.n_unknowns), bounds)
    assert all(np.all(np.abs(each.theta) <= 0.1) for each in mixture.explanations)
    assert mixture.mean == pytest.approx([0.1, -0.1])


@pytest.mark.parametrize("n_images", [1, 2])
def test_a_modulus_that_moves_nothing_has_no_finite_interval_and_the_other_one_its_own(patients, n_images):
    rng = np.random.default_rng(11)
    of = patients.patient(rng, n_images, gain=(1.0, 0.0))
    mixture = mixture_at(of.objective(rng), place(of))
    assert np.isfinite(mixture.mean).all()
    assert mixture.covariance[1, 1] == np.inf
    assert mixture.covariance[0, 1] == pytest.approx(0.0, abs=1e-12)
    assert 0.0 < mixture.covariance[0, 0] < 1e-2


def test_minima_of_one_explanation_are_told_apart_and_weighed(patients):
    """Of a body that answers to ln E as to 2 - ln E: both, as likely, wherever the first one is sought."""
    rng = np.random.default_rng(12)
    of = patients.without(patients.patient(rng, bend=-1.0), (0, 1, 2, 3))
    objective = of.objective(rng, whole=True)
    near, far = (np.concatenate([theta, np.zeros(len(of.truth) - 2)]) for theta in ([0.5, -0.3], [1.5, -0.3]))
    for at, other in ((near, far), (far, near)):
        assert len(mixture_at(objective, at, begins=[at]).explanations) == len(mixture_at(objective, at).explanations)
        mixture = mixture_at(objective, at, begins=[other, other])
        same = [each for each in mixture.explanations if each.chosen == mixture.explanations[0].chosen]
        assert len(same) == 2
        low, high = sorted(each.theta[0] for each in same)
        assert low + high == pytest.approx(2.0, abs=0.01)
        assert high - low > 0.5
        assert same[0].weight == pytest.approx(same[1].weight, rel=0.02)


@pytest.mark.parametrize("theta", [0.5, 0.8, 1.2, 1.5])
def test_minima_of_one_explanation_stay_apart_in_iterations_of_a_search(patients, theta):
    """Of a body that answers to ln E as to 2 - ln E: the next one seeks each where the last one found it."""
    rng = np.random.default_rng(12)
    of = patients.without(patients.patient(rng, bend=-1.0), (0, 1, 2, 3))
    objective = of.objective(rng, whole=True)
    near, far, here = (np.concatenate([[first, -0.3], np.zeros(len(of.truth) - 2)]) for first in (0.5, 1.5, theta))
    first = mixture_at(objective, near, begins=[near, far])
    mixture = mixture_at(objective, here, begins=[near, far], earlier=first)
    same = [each for each in mixture.explanations if each.chosen == mixture.explanations[0].chosen]
    low, high = sorted(float(each.theta[0]) for each in same)
    assert low + high == pytest.approx(2.0, abs=0.01)
    assert high - low > 0.5
    places = {each.key: each.theta[0] for each in first.explanations}
    assert all(each.theta[0] == pytest.approx(places[each.key], abs=0.01) for each in same)
    assert mixture.weights.sum() == pytest.approx(1.0)


def with_outliers(objective, *, cutoff=2.0, by=12.0):
    """The objective with robust losses, some of whose readings are off by so many standard deviations."""
    observations = []
    for o in objective.observations:
        seen = o.seen.copy()
        seen[::4] += by * o.weighting.sd
        weighting = replace(o.weighting, loss=PowerLaw(cutoff * o.weighting.sd))
        observations.append(replace(o, seen=seen, weighting=weighting))
    return objective.with_observations(observations)


def robust_minimum(objective, start):
    return gauss_newton(objective, start, bounds=Bounds(np.full(2, -4.0), np.full(2, 4.0)), tolerance=1e-12)


def test_the_level_of_an_explanation_is_that_of_its_robust_losses(patients):
    """-J - 1/2 ln det H + 1/2 ln det P at its own minimum with its log prior odds: those of two can be compared."""
    rng = np.random.default_rng(13)
    of = patients.patient(rng)
    objective, outlying, found = with_outliers(of.objective(rng)), [], []
    for k in range(3):
        chosen = {0: k, 1: k, 2: 0, 3: 0, FRAME: 0, GLAND: 0, SAC: 0}
        own = objective.with_prior(objective.parameters.choosing(chosen))
        minimum = robust_minimum(own, np.zeros(len(of.truth)))
        there, scenario = minimum.evaluation, Candidates(lambda each, own=chosen: each.chosen == tuple(own.items())[:5])
        at = cheapest_posterior(objective, minimum.unknowns, there)
        mixture = mixture_of(at, minimum.unknowns, there, Bounds(np.full(2, -4.0), np.full(2, 4.0)), scenario)
        (level,) = (each.level for each in mixture.explanations if each.chosen == chosen)
        priors = zip(own.parameters.blocks, chosen.items(), strict=True)
        odds = sum(block.alternatives[k].log_odds for block, (i, k) in priors if i in (0, 2, FRAME))
        determinants = sum(p.log_determinant for p in own.parameters.priors) - there.matrix.log_determinant()
        found.append(level - (odds - there.value + 0.5 * determinants))
        squares = sum(t.precision * float(t.weights @ t.residuals.values**2) for t in there.linearisations)
        outlying.append(there.value - there.prior_value - 0.5 * squares)
    assert np.ptp(outlying) > 0.1  # or there would be nothing to show
    assert found == pytest.approx([found[0]] * 3, abs=0.03)


@pytest.mark.parametrize("sds", [0.1, 0.3])
def test_levels_that_are_made_at_different_places_agree(patients, sds):
    """So many standard deviations from the minimum to both sides, each with the weights there."""
    rng = np.random.default_rng(13)
    of = patients.patient(rng)
    objective, levels = with_outliers(of.objective(rng)), []
    best = mixture_at(objective, robust_minimum(objective, np.zeros(len(of.truth))).unknowns)
    for sign in (-1.0, 0.0, 1.0):
        x = best.minimum.unknowns.copy()
        x[:2] += sign * sds * best.sd * np.array([1.0, -1.0])
        levels.append({each.key: each.level for each in mixture_at(objective, x).explanations[:3]})
    for key in levels[1]:
        assert [level[key] for level in levels] == pytest.approx([levels[1][key]] * 3, abs=0.1)
