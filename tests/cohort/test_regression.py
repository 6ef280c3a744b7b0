"""Stiffness by stage where some scans have no value: its test is exact, and what is stiff is not left out."""

from __future__ import annotations

import math
from itertools import permutations

import numpy as np
import pytest
from scipy import stats

from palpate.cohort.statistics.association import association, permutation_test
from palpate.cohort.statistics.regression import PatientScans, stage_regression
from palpate.cohort.statistics.scans import Scan

GROWTH = 1.3


def scan(name, patient, stage, value, low, high):
    return Scan(name, patient, "", stage, value, low, high)


def saturating(seed, *, n=40):
    """Scans that measure 1 / E with a noise of their own, so that what is stiff is bounded from below alone.

    Two of each patient, E = 20 kPa times 1.3 a stage, 20 % between patients and 10 % within.
    """
    rng, found = np.random.default_rng(seed), []
    for patient in range(n):
        stage, own = 1 + patient % 4, 0.2 * rng.standard_normal()
        for again in range(2):
            modulus = 20.0 * GROWTH**stage * math.exp(own + 0.1 * rng.standard_normal())
            softness, reach = 1.0 / modulus + 0.008 * rng.standard_normal(), 1.96 * 0.008
            low, high = 1.0 / (softness + reach), 1.0 / (softness - reach) if softness > reach else None
            value = 1.0 / softness if high is not None and high / low <= 10.0 else None
            found.append(scan(f"{patient}-{again}", f"P{patient}", stage, value, low, high))
    return found


@pytest.fixture(scope="module")
def regressions():
    """With censored scans, and with the values alone: of the same six cohorts."""
    cohorts = [saturating(seed) for seed in range(6)]
    every = [stage_regression(scans) for scans in cohorts]
    return every, [stage_regression([one for one in scans if one.value is not None]) for scans in cohorts]


def holds(found):
    low, high = found["interval95"]
    return low < GROWTH and (high is None or high > GROWTH)


def test_censored_scans_recover_a_growth_that_dropping_them_loses(regressions):
    errors = [np.log([found["factor_per_stage"] for found in of]) / math.log(GROWTH) - 1.0 for of in regressions]
    assert abs(errors[0].mean()) < 0.2
    assert errors[1].mean() < -0.3
    assert sum(map(holds, regressions[0])) > sum(map(holds, regressions[1]))
    assert sum(map(holds, regressions[0])) >= 5


def test_without_an_effect_the_p_of_all_arrangements_is_uniform():
    """Of the 12 ways in which stages could have met these patients, exactly the share p has no larger p."""
    scans = [
        (20.0, 19.0, 21.0),
        (31.0, 25.0, 40.0),
        (17.0, 12.0, 20.0),
        (None, 30.0, None),
    ]
    found = []
    for order in sorted(set(permutations((1, 1, 2, 4)))):
        rows = [scan(f"r{i}", f"P{i}", stage, *scans[i]) for i, stage in enumerate(order)]
        found.append(stage_regression(rows)["p"])
    assert [np.mean(np.array(found) <= p + 1e-12) for p in sorted(found)] == pytest.approx(sorted(found))


def test_the_p_of_all_arrangements_is_scipys():
    rng = np.random.default_rng(1)
    x, scores = rng.normal(size=(2, 6))

    def size(order):
        return abs(float((x - x.mean()) @ order))

    exact = stats.permutation_test((scores,), size, permutation_type="pairings", alternative="greater", n_resamples=720)
    found = permutation_test(x, scores, seed=0)
    assert (found.p, found.arrangements, found.exact) == (pytest.approx(exact.pvalue), 720, True)


def test_without_an_effect_the_p_of_seeded_draws_is_as_small_as_stated():
    rng = np.random.default_rng(2)
    stages = np.repeat([1.0, 2.0, 3.0, 4.0], 5)
    found = [permutation_test(stages, rng.standard_t(2.0, size=20), seed=0) for _ in range(1000)]
    assert not any(each.exact for each in found)
    assert 0.03 < np.mean([each.p <= 0.05 for each in found]) < 0.07
    assert min(each.p for each in found) >= 1.0 / found[0].arrangements


def test_the_order_of_scans_changes_nothing():
    scans = saturating(3, n=12)
    shuffled = [scans[i] for i in np.random.default_rng(0).permutation(len(scans))]
    assert stage_regression(shuffled) == stage_regression(scans)


def test_the_interval_ends_where_the_test_no_longer_rejects():
    scans = saturating(5, n=8)
    low, _ = stage_regression(scans)["interval95"]
    for factor, rejected in ((low * 0.98, True), (low * 1.02, False)):
        shifted = [
            scan(each.id, each.patient, each.stage, *(end and end / factor**each.stage for end in ends))
            for each in scans
            for ends in [(each.value, each.low95, each.high95)]
        ]
        assert (stage_regression(shifted)["p"] < 0.05) == rejected


def test_without_noise_the_growth_is_found():
    scans = [scan(f"r{i}", f"P{i}", 1 + i, 10.0 * 1.5**i, 10.0 * 1.5**i, 10.0 * 1.5**i) for i in range(6)]
    found = stage_regression(scans)
    assert found["factor_per_stage"] == pytest.approx(1.5, rel=1e-4)
    assert found["at_mean_stage"] == pytest.approx(10.0 * 1.5**2.5, rel=1e-4)
    assert found["p"] == pytest.approx(2.0 / math.factorial(6))


def test_no_interval_is_stated_where_no_arrangement_could_be_rare():
    scans = [scan(f"r{i}", f"P{i}", i, 10.0 + i, 9.0, 15.0) for i in range(3)]
    found = stage_regression(scans)
    assert found["p"] == pytest.approx(1.0 / 3.0)
    assert found["interval95"] == [None, None]


def test_an_age_that_goes_with_the_stage_is_not_taken_for_it():
    """E follows the age alone."""
    rng = np.random.default_rng(4)
    ages = {f"r{i}": 40.0 + 10.0 * (i % 4) + 4.0 * rng.standard_normal() for i in range(24)}
    values = [math.exp(0.05 * ages[f"r{i}"] + 0.05 * rng.standard_normal()) for i in range(24)]
    scans = [scan(f"r{i}", f"P{i}", i % 4, v, 0.9 * v, v / 0.9) for i, v in enumerate(values)]
    alone, adjusted = stage_regression(scans), stage_regression(scans, covariates={"age": ages, "none": {}})
    assert alone["interval95"][0] > 1.3
    low, high = adjusted["interval95"]
    assert low < 1.0 < high
    assert (adjusted["covariates"], "p" in adjusted) == (["age"], False)


def test_tau_is_kendalls_and_takes_what_intervals_leave_open_as_ties():
    rng = np.random.default_rng(6)
    stages, values = rng.integers(1, 5, size=15).astype(float), rng.normal(10.0, 2.0, size=15)
    parts = [np.array([value]) for value in values]
    found = association(parts, parts, stages).per_patient
    expected = [stats.pearsonr, stats.spearmanr, stats.kendalltau]
    assert (found.r, found.rho, found.tau) == pytest.approx([of(stages, values).statistic for of in expected])
    stages, lows = np.array([1.0, 2.0, 3.0]), [np.array([low]) for low in (10.0, 20.0, 15.0)]
    highs = [np.array([high]) for high in (10.0, 20.0, math.inf)]
    opened = association(lows, highs, stages).per_patient
    assert (opened.r, opened.rho, opened.n_censored) == (None, None, 1)
    assert opened.tau == pytest.approx(
        2.0 / math.sqrt(2.0 * 3.0)
    )  # of three pairs two are told, both go with the stage


def test_the_likelihoods_derivatives_are_those_of_differences():
    """By each patient's mean and both scatters, of values and of intervals, also of ones without an end."""
    rng = np.random.default_rng(8)
    scans = PatientScans(
        n=7,
        y=rng.normal(3.0, 1.0, 9),
        variances=rng.uniform(0.01, 0.2, 9),
        of_value=np.array([0, 1, 1, 2, 3, 3, 4, 5, 0]),
        lows=np.array([-np.inf, 1.0, 2.0, -1.0]),
        highs=np.array([2.0, np.inf, 4.0, 1.5]),
        of_censored=np.array([6, 6, 2, 5]),
    )
    mean, step = rng.normal(3.0, 0.5, 7), 1e-5

    def slope(by):
        """Central differences of the values (n,) along a change of the mean, ln between and ln within."""
        ahead, behind = (
            scans.log_likelihood(mean + s * by[0], 0.4 * np.exp(s * by[1]), 0.3 * np.exp(s * by[2])).values
            for s in (step, -step)
        )
        return (ahead - behind) / (2.0 * step)

    stated = scans.log_likelihood(mean, 0.4, 0.3)
    assert stated.by_mean == pytest.approx(slope((1.0, 0.0, 0.0)), abs=1e-7)
    assert stated.by_sd == pytest.approx(np.stack([slope((0.0, 1.0, 0.0)), slope((0.0, 0.0, 1.0))]), abs=1e-7)
