"""What is stated of an inversion: intervals, verdicts, every start, and never a result that did not converge."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from palpate.inversion.conclude import Observed, conclude
from palpate.inversion.gauss_newton import Outcome
from palpate.inversion.grid_position import FittedState, grid_position_shifts
from palpate.inversion.invert import invert
from palpate.inversion.noise import NoiseLaw
from palpate.inversion.posterior import sandwich_covariance

LAW = NoiseLaw(np.array([0.03**2]), np.array([3.0]))


@pytest.fixture(scope="module")
def settings(twins):
    return twins.settings(0.5, 8.0, law=LAW)


@pytest.fixture(scope="module")
def inversion(twins, exact, settings):
    return invert(exact, settings, progress=twins.silent)


def observed_of(twin, grid=None):
    grid = grid or twin.scene.before.grid
    displacement = twin.scene.displacement
    state = FittedState(displacement, grid, grid, 0.6 * float(grid.spacing.max()))
    return Observed(twin.model.space, (state,), ((twin.scene.after.labels - 1).astype(np.int16),))


@pytest.fixture(scope="module")
def observed(twin):
    return observed_of(twin)


@pytest.fixture(scope="module")
def estimation(inversion, settings, observed):
    return conclude(inversion, settings, observed, truth={"gland": 30.0}, seed=1)


def spoilt(inversion, outcome):
    return replace(inversion, minima=tuple(replace(m, outcome=outcome) for m in inversion.minima))


def test_moduli_are_stated_in_kpa_and_as_ratios(estimation):
    gland, sac = estimation.estimates
    assert (gland.tissue, gland.unit, gland.relative_to, gland.truth) == ("gland", "kPa", "rest", 30.0)
    assert (gland.value, sac.value) == pytest.approx((30.0, 20.0), rel=0.02)
    assert gland.ratio == pytest.approx(gland.value / 10.0)
    assert gland.interval95 == pytest.approx(tuple(10.0 * end for end in gland.ratio_interval95))
    assert sac.truth is None
    assert gland.interval95[0] < 30.0 < gland.interval95[1]


def test_the_interval_is_that_of_the_covariance(estimation):
    sd = np.sqrt(np.diag(estimation.covariance))
    widths = [np.log(e.ratio_interval95[1] / e.ratio_interval95[0]) for e in estimation.estimates]
    assert widths == pytest.approx(2.0 * 1.96 * sd, rel=1e-4)
    assert np.diag(estimation.correlation) == pytest.approx(1.0)


def test_the_place_of_the_grid_adds_to_the_residuals_law(estimation, inversion):
    residuals = sandwich_covariance(inversion.minimum.evaluation, inversion.law, 2)
    grid = estimation.covariance - residuals
    assert np.all(np.diag(grid) > 1e-3 * np.diag(residuals))
    assert np.linalg.eigvalsh(grid).min() > -1e-12


def test_every_start_is_told(estimation):
    assert estimation.status == "converged"
    assert [start.start["gland"] for start in estimation.starts] == pytest.approx([5.0, 80.0])
    assert {start.minimum for start in estimation.starts} == {0}
    assert all(start.iterations > 1 for start in estimation.starts)
    assert "2 of 2 starts" in estimation.reason
    assert "1 distinct minimum" in estimation.reason


def test_the_fit_gets_better_from_rest_to_the_estimate(estimation):
    (fits,) = estimation.fits
    assert [fit.tissue for fit in fits] == ["gland", "sac", "tube"]
    for fit in fits:
        assert fit.end.rms_mm < 0.1 * fit.start.rms_mm
        assert fit.end.mean_mm <= fit.end.rms_mm
        assert fit.end.mean_mm <= fit.end.hd95_mm
        assert fit.end.dice > 0.99 > fit.start.dice
        assert fit.observed_share == 1.0


def test_what_did_not_converge_says_so(inversion, settings, observed):
    result = conclude(spoilt(inversion, Outcome.STEPS), settings, observed, truth={}, seed=1)
    assert result.status == "not converged"
    assert "largest number of steps" in result.reason
    assert "0 of 2 starts" in result.reason
    assert {start.status for start in result.starts} == {"not converged"}


def test_one_start_that_converged_is_enough(inversion, settings, observed):
    best = inversion.best
    minima = tuple(m if i == best else replace(m, outcome=Outcome.STUCK) for i, m in enumerate(inversion.minima))
    result = conclude(replace(inversion, minima=minima), settings, observed, truth={}, seed=1)
    assert result.status == "converged"
    assert "1 of 2 starts" in result.reason


def test_an_estimate_at_its_bound_is_not_identified(twins, twin, exact):
    settings = twins.settings(1.0, limits=(0.5, 2.5), law=LAW)
    inversion = invert(exact, settings, progress=twins.silent)
    result = conclude(inversion, settings, observed_of(twin), truth={}, seed=1)
    gland = result.estimates[0]
    assert gland.value == pytest.approx(25.0)
    assert gland.verdict == "not identified"
    assert "lies at its bound" in gland.why
    assert gland.interval95[1] is None


def test_an_imprecise_image_identifies_nothing(inversion, settings, observed):
    vague = replace(inversion, law=NoiseLaw(np.array([1.0]), np.array([6.0])))
    verdicts = [e.verdict for e in conclude(vague, settings, observed, truth={}, seed=1).estimates]
    assert "identified" not in verdicts
    assert "not identified" in verdicts


def test_without_a_known_modulus_there_is_no_kpa(twins):
    twin = twins.make_twin(rest_kpa=None)
    settings = twins.settings(1.0, law=LAW)
    inversion = invert(twins.exact_problem(twin), settings, progress=twins.silent)
    result = conclude(inversion, settings, observed_of(twin), truth={}, seed=1)
    assert [e.tissue for e in result.estimates] == ["sac", "rest"]
    for estimate in result.estimates:
        assert (estimate.unit, estimate.relative_to) == ("ratio", "gland")
        assert (estimate.value, estimate.interval95) == (None, None)
        assert estimate.verdict in ("ratio only", "not identified")
    assert [e.ratio for e in result.estimates] == pytest.approx([2.0 / 3.0, 1.0 / 3.0], rel=0.02)
    assert "ratio-only" in [remark.code for remark in result.remarks]


def test_distinct_minima_are_remarked(inversion, settings, observed):
    result = conclude(replace(inversion, groups=(0, 1)), settings, observed, truth={}, seed=1)
    assert "several-minima" in [remark.code for remark in result.remarks]
    assert "2 distinct minima" in result.reason


def test_finer_voxels_leave_less_to_the_place_of_the_grid(twins, twin, inversion):
    spread = []
    for spacing in (3.0, 1.5):
        grid = twins.centred_grid((44.0,) * 3, (spacing,) * 3)
        states = observed_of(twin, grid).states
        shifts = grid_position_shifts(inversion, twin.model.space, states, draws=6, rng=np.random.default_rng(2))
        spread.append(np.sqrt(np.mean(shifts**2)))
    assert 0.0 < spread[1] < 0.7 * spread[0]


def test_the_same_seed_gives_the_same_statement(inversion, settings, observed, estimation):
    again = conclude(inversion, settings, observed, truth={"gland": 30.0}, seed=1)
    assert np.array_equal(again.covariance, estimation.covariance)


@pytest.mark.parametrize(("worse_by", "counts"), [(0.01, True), (0.5, False)])
def test_another_minimum_that_fits_as_well_is_within_the_interval(inversion, settings, observed, worse_by, counts):
    best = inversion.minimum
    far = best.unknowns.copy()
    far[0] += 1.0
    value = (1.0 + worse_by) * best.evaluation.value
    other = replace(best, unknowns=far, evaluation=replace(best.evaluation, value=value))
    both = replace(inversion, minima=(best, other), groups=(0, 1), best=0)
    low, high = conclude(both, settings, observed, truth={}, seed=1).estimates[0].interval95
    assert low < 30.0
    assert (high > 30.0 * np.e) == counts
