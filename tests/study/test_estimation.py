"""What is stated of an inversion: intervals, verdicts, every start, and never a result that did not converge."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import pytest
from scipy import stats

from palpate.errors import SolverError
from palpate.images.tissue import Role
from palpate.inversion import REPORTED, Explanation, Inversion, Mixture, Outcome, frozen_posterior, gauss_newton, invert
from palpate.mechanics.forward import SolveCounts
from palpate.observation.noise_model import NoiseModel
from palpate.statement.conclusion import Observed, conclude
from palpate.statement.samples import draw_moduli
from palpate.statement.stated_posterior import as_stated, profiled
from palpate.statement.verdicts import estimates_of, intervals_of, or_as_ratio, verdict
from palpate.uncertainty import (
    FittedState,
    grid_position_shifts,
    mesh_covariance,
    sandwich_covariance,
)
from palpate.uncertainty.covariance import scatter
from palpate.uncertainty.marginals import CORRELATED
from palpate.unknowns import known_modulus_blocks

NOISE = NoiseModel(np.array([0.03**2]), np.array([3.0]))


@pytest.fixture(scope="module")
def settings(twins):
    return twins.settings(0.5, 8.0)


@pytest.fixture(scope="module")
def inversion(twins, twin, settings):
    return invert(twins.exact_problem(twin, noise=NOISE), settings, progress=twins.silent)


def observed_of(twin):
    grid = twin.scene.before.grid
    state = FittedState(twin.model.space, twin.scene.displacement, grid, grid)
    return Observed((state,), ((twin.scene.after.labels - 1).astype(np.int16),))


@pytest.fixture(scope="module")
def observed(twin):
    return observed_of(twin)


@pytest.fixture(scope="module")
def estimation(inversion, settings, observed):
    return conclude(inversion, settings, observed, truth={"gland": 30.0}, seed=1)


def stated(inversion, settings, observed):
    return conclude(inversion, settings, observed, truth={}, seed=1)


def codes(estimation):
    return [remark.code for remark in estimation.remarks]


def one_explanation(minimum, n=2):
    """The mixture of one explanation of the images, that of a minimum."""
    covariance = minimum.evaluation.covariance_columns(n)[:n]
    return Mixture((Explanation({}, (), ((),), 1.0, minimum.unknowns[:n], covariance, minimum),))


def spoilt(inversion, outcome, starts=(0, 1)):
    """The inversion whose starts, and what came of them, ended with an outcome."""
    ended = tuple(
        replace(s, minimum=replace(s.minimum, outcome=outcome)) if i in starts else s
        for i, s in enumerate(inversion.starts)
    )
    return replace(inversion, starts=ended)


def test_moduli_are_stated_in_kpa_and_as_ratios(estimation):
    gland, sac = estimation.estimates
    assert (gland.tissue, gland.unit, gland.relative_to, gland.truth) == ("gland", "kPa", "rest", 30.0)
    assert (gland.value, sac.value) == pytest.approx((30.0, 20.0), rel=0.02)
    assert gland.ratio == pytest.approx(gland.value / 10.0)
    assert gland.interval95 == pytest.approx(tuple(10.0 * end for end in gland.ratio_interval95))
    assert sac.truth is None
    assert gland.interval95[0] < 30.0 < gland.interval95[1]


def test_the_interval_is_that_of_the_covariance(estimation):
    sd = np.sqrt(np.diag(estimation.covariance.total))
    widths = [np.log(e.ratio_interval95[1] / e.ratio_interval95[0]) for e in estimation.estimates]
    assert widths == pytest.approx(2.0 * 1.96 * sd, rel=1e-4)
    assert np.diag(estimation.correlation) == pytest.approx(1.0)


def test_the_place_of_the_grid_is_in_the_interval_once(twins, twin, voxels, settings, observed):
    """Residuals through voxels are rounded, too: the interval holds the noise and the grid, and not both on top."""
    objective = twins.objective_of(voxels, twin.coefficients).rematched(twin.unknowns)
    minimum = gauss_newton(objective, twin.unknowns, bounds=settings.bounds, max_steps=3)
    given = objective, minimum, one_explanation(minimum)
    found = Inversion(*given, (), minimum.evaluation, 0, SolveCounts())
    estimation = stated(found, settings, observed)
    residuals = sandwich_covariance(objective, minimum.evaluation)
    moved = grid_position_shifts(objective, minimum.evaluation, observed.states, rng=np.random.default_rng(1))
    alone = scatter(moved)
    assert np.all(np.diag(alone) > 1e-3 * np.diag(residuals))
    rest = estimation.covariance.total - mesh_covariance(objective)
    for part in (alone, residuals):
        assert np.linalg.eigvalsh(rest - part).min() > -1e-12
    assert np.all(np.diag(rest) < np.diag(residuals) + 0.999 * np.diag(alone))


def test_surfaces_without_voxels_leave_nothing_to_the_place_of_the_grid(estimation, inversion):
    assert not estimation.covariance.grid.any()
    residuals = np.diag(sandwich_covariance(inversion.objective, inversion.minimum.evaluation))
    least = np.diag(inversion.mixture.covariance)
    rest = np.diag(estimation.covariance.total - mesh_covariance(inversion.objective))
    assert rest == pytest.approx(np.clip(residuals, least, CORRELATED**2 * least), rel=1e-6)


def test_every_start_is_told(estimation):
    assert estimation.status == "converged"
    assert [start.start["gland"] for start in estimation.starts] == pytest.approx([5.0, 80.0])
    assert {start.minimum for start in estimation.starts} == {0}
    assert all(start.iterations > 1 for start in estimation.starts)
    assert "2 of 2 starts" in estimation.reason
    assert "1 distinct minimum" in estimation.reason


def test_every_start_has_its_own_steps_and_the_outer_loop_stands_once(estimation, inversion):
    """No step of one start is told as another's, and those that all starts share are told apart from them."""
    gland = [[step.moduli["gland"] for step in start.history] for start in estimation.starts]
    assert [start.start["gland"] for start in estimation.starts] == pytest.approx([steps[0] for steps in gland])
    assert [start.end["gland"] for start in estimation.starts] == pytest.approx([steps[-1] for steps in gland])
    assert not set(gland[0]) & set(gland[1])
    outer = [step.moduli["gland"] for step in estimation.outer_loop]
    assert len(outer) == len(inversion.minimum.history) >= 1
    assert outer[0] == pytest.approx(20.0)  # the middle of 5 and 80
    assert all(outer[-1] == pytest.approx(start.end["gland"], rel=0.05) for start in estimation.starts)  # one minimum
    within = REPORTED.step_sd * inversion.mixture.sd[0]
    assert np.log(outer[-1]) == pytest.approx(np.log(estimation.estimates[0].value), abs=within)


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
    ended = spoilt(replace(inversion, minimum=replace(inversion.minimum, outcome=Outcome.STEPS)), Outcome.STEPS)
    result = stated(ended, settings, observed)
    assert result.status == "not converged"
    assert "largest number of steps" in result.reason
    assert "0 of 2 starts" in result.reason
    assert "converged" not in result.reason
    assert {start.status for start in result.starts} == {"not converged"}
    assert {(e.value, e.interval95, e.ratio, e.verdict) for e in result.estimates} == {
        (None, None, None, "not identified")
    }


def test_an_estimate_that_did_not_end_is_not_said_to_have_converged_where_its_starts_did(inversion, settings, observed):
    ended = replace(inversion, minimum=replace(inversion.minimum, outcome=Outcome.STUCK))
    result = stated(ended, settings, observed)
    assert result.status == "not converged"
    assert {start.status for start in result.starts} == {"converged"}
    assert "2 of 2 starts led to 1 distinct minimum" in result.reason
    assert "converged" not in result.reason
    assert not any("converged" in of.why for of in result.estimates)


def test_starts_that_were_not_followed_are_no_minimum(inversion, settings, observed):
    first, second = inversion.starts
    result = stated(replace(inversion, starts=(first, replace(second, candidate=None))), settings, observed)
    assert "2 of 2 starts converged, to 1 distinct minimum" in result.reason
    assert [start.minimum for start in result.starts] == [0, None]


def test_one_start_that_converged_is_enough(inversion, settings, observed):
    result = stated(spoilt(inversion, Outcome.STUCK, starts=(1,)), settings, observed)
    assert result.status == "converged"
    assert "1 of 2 starts" in result.reason
    assert [start.status for start in result.starts] == ["converged", "not converged"]


def test_an_estimate_at_its_bound_is_not_identified(twins, twin, observed):
    settings = twins.settings(1.0, limits=(0.5, 2.5))
    inversion = invert(twins.exact_problem(twin, noise=NOISE), settings, progress=twins.silent)
    result = stated(inversion, settings, observed)
    gland = result.estimates[0]
    assert gland.value == pytest.approx(25.0)
    assert gland.verdict == "not identified"
    assert "lies at its bound" in gland.why
    assert (gland.interval95, gland.ratio_interval95, gland.interval95_given_model) == (None, None, None)
    assert result.regions == ()


def test_an_imprecise_image_identifies_nothing(inversion, settings, observed):
    rough, objective = NoiseModel(np.array([1.0]), np.array([6.0])), inversion.objective
    stated_noise = [replace(o.with_noise(rough), stated_noise=rough) for o in objective.observations]
    vague = objective.with_observations(stated_noise)
    minimum = replace(inversion.minimum, evaluation=vague(inversion.minimum.unknowns))
    unknown = replace(inversion, objective=vague, minimum=minimum, mixture=one_explanation(minimum))
    found = conclude(unknown, settings, observed, truth={}, seed=1, samples=100)
    verdicts = [e.verdict for e in found.estimates]
    assert "identified" not in verdicts
    assert "not identified" in verdicts
    for estimate, drawn in zip(found.estimates, found.samples.interval95, strict=True):
        assert (estimate.interval95 is None) == (estimate.verdict == "not identified")
        assert (estimate.ratio_interval95 is None) == (estimate.interval95_given_model is None)
        assert estimate.interval95 is not None or np.isnan(drawn).any()


def test_without_a_known_modulus_there_is_no_kpa(twins):
    twin = twins.make_twin(rest_kpa=None)
    settings = twins.settings(1.0)
    inversion = invert(twins.exact_problem(twin, noise=NOISE), settings, progress=twins.silent)
    result = conclude(inversion, settings, observed_of(twin), truth={}, seed=1, samples=4000)
    assert [e.tissue for e in result.estimates] == ["sac", "rest"]
    assert (result.samples.tissues, result.samples.unit) == (("sac", "rest"), "ratio")
    assert np.median(result.samples.moduli, axis=0) == pytest.approx([2.0 / 3.0, 1.0 / 3.0], rel=0.05)
    for estimate in result.estimates:
        assert (estimate.unit, estimate.relative_to) == ("ratio", "gland")
        assert (estimate.value, estimate.interval95) == (None, None)
        assert estimate.verdict in ("ratio only", "not identified")
    assert [e.ratio for e in result.estimates] == pytest.approx([2.0 / 3.0, 1.0 / 3.0], rel=0.02)
    assert "ratio-only" in codes(result)


def of_two(inversion, *, share=0.5, away=1.0, chosen=({}, {})):
    """The mixture of the inversion's explanation and another one, ln E of the gland larger by so much."""
    (only,) = inversion.mixture.explanations
    other = replace(only, theta=only.theta + np.array([away, 0.0]), weight=1.0 - share, chosen=chosen[1])
    both = (replace(only, weight=share, chosen=chosen[0]), other)
    parameters = inversion.objective.parameters
    first, *rest = parameters.blocks
    first = replace(first, alternatives=(first.alternatives[0],) * 2)  # what is chosen must be there
    objective = inversion.objective.with_prior(replace(parameters, blocks=(first, *rest)))
    return replace(inversion, objective=objective, mixture=replace(inversion.mixture, explanations=both))


def test_several_minima_of_one_explanation_are_remarked_and_several_explanations_are_not(
    estimation, inversion, settings, observed
):
    assert "several-minima" in codes(stated(of_two(inversion), settings, observed))
    assert "several-minima" not in codes(stated(of_two(inversion, share=0.97), settings, observed))
    assert "several-minima" not in codes(stated(of_two(inversion, chosen=({0: 0}, {0: 1})), settings, observed))
    assert "several-minima" not in codes(estimation)


def test_starts_that_lead_to_different_minima_are_told(inversion, settings, observed):
    first, second = inversion.starts
    result = stated(replace(inversion, starts=(first, replace(second, candidate=1))), settings, observed)
    assert "2 distinct minima" in result.reason
    assert [start.minimum for start in result.starts] == [0, 1]


def test_the_interval_holds_every_explanation_that_may_be_and_the_value_is_the_median(
    estimation, inversion, settings, observed
):
    alone = estimation.estimates[0]
    result = stated(of_two(inversion, share=0.6), settings, observed)
    gland, sac = result.estimates
    low, high = gland.interval95
    sd = np.sqrt(estimation.covariance.total[0, 0])
    below, above = np.log(low / alone.value), np.log(high / alone.value) - 1.0
    assert (below, above) == pytest.approx(
        (sd * stats.norm.ppf(0.025 / 0.6), -sd * stats.norm.ppf(0.025 / 0.4)), rel=0.01
    )
    assert alone.interval95[0] < gland.value < alone.interval95[1]
    assert gland.variance_shares["minima"] == pytest.approx(0.6 * 0.4 / (0.6 * 0.4 + sd**2))
    assert sum(gland.variance_shares.values()) == pytest.approx(1.0, abs=1e-9)
    assert sac.interval95 == pytest.approx(estimation.estimates[1].interval95, rel=1e-6)
    assert gland.verdict == "weak"
    seldom = stated(of_two(inversion, share=0.999), settings, observed).estimates[0]
    assert seldom.interval95 == pytest.approx(alone.interval95, rel=0.01)


def test_explanations_are_stated_with_their_moduli_down_to_one_in_a_hundred(inversion, settings, observed):
    first, second = stated(of_two(inversion, share=0.6), settings, observed).explanations
    assert (first.probability, second.probability) == pytest.approx((0.6, 0.4))
    assert first.moduli["gland"] == pytest.approx(30.0, rel=0.02)
    assert second.moduli["gland"] == pytest.approx(np.e * first.moduli["gland"])
    assert second.moduli["sac"] == pytest.approx(first.moduli["sac"])
    assert len(stated(of_two(inversion, share=0.995), settings, observed).explanations) == 1
    lost = replace(inversion, minimum=replace(inversion.minimum, outcome=Outcome.STEPS))
    assert stated(lost, settings, observed).explanations == ()


def test_an_estimate_whose_search_ran_out_says_so(estimation, inversion, settings, observed):
    assert "unsettled" not in codes(estimation)
    ended = replace(inversion, minimum=replace(inversion.minimum, outcome=Outcome.STEPS))
    result = stated(spoilt(ended, Outcome.STEPS), settings, observed)
    (remark,) = (remark for remark in result.remarks if remark.code == "unsettled")
    assert Outcome.STEPS.value in remark.message
    assert result.status == "not converged"


def with_range(twins, twin, settings, *, sd):
    """The twin's estimate where ln E of the known tissue is believed to be within sd."""
    tissues = tuple(replace(t, modulus_sd=sd * (t.role is Role.KNOWN)) for t in twin.scene.tissues)
    problem = twins.exact_problem(twin, noise=NOISE)
    blocks = (*problem.parameters.blocks, *known_modulus_blocks(tissues, twin.model.regions, (0,)))
    mapping = replace(problem.parameters, blocks=blocks, priors=())
    return invert(replace(problem, parameters=mapping), settings, progress=twins.silent)


def test_a_range_of_the_known_modulus_is_in_kilopascals_and_not_in_ratios(
    twins, twin, inversion, settings, observed, estimation
):
    """All moduli scaled together move nothing: no image tells more of the known one than was believed before."""
    found = with_range(twins, twin, settings, sd=0.2)
    result = stated(found, settings, observed)
    assert found.minimum.unknowns[:2] == pytest.approx(inversion.minimum.unknowns[:2], abs=1e-3)
    added = np.diag(result.covariance.total) - np.diag(estimation.covariance.total)
    assert added == pytest.approx(0.2**2, rel=0.02)
    for of_range, of_number in zip(result.estimates, estimation.estimates, strict=True):
        assert of_range.ratio_interval95 == pytest.approx(of_number.ratio_interval95, rel=0.02)
        assert np.divide(*of_range.interval95[::-1]) > np.exp(3.92 * 0.2)
        assert of_range.variance_shares["known modulus"] == pytest.approx(0.04 / result.covariance.total[0, 0], rel=0.5)


def test_what_a_range_leaves_open_is_told_as_a_ratio(twins, twin, settings, observed):
    found = with_range(twins, twin, settings, sd=0.5)
    for estimate in stated(found, settings, observed).estimates:
        assert estimate.verdict == "ratio only"
        assert "range of the known modulus" in estimate.why
        assert np.divide(*estimate.ratio_interval95[::-1]) < 4.0 < np.divide(*estimate.interval95[::-1])


@pytest.mark.parametrize(
    ("word", "by_ratio", "told"),
    [
        ("not identified", (1.0, 3.0), "ratio only"),
        ("weak", (1.0, 3.0), "ratio only"),
        ("weak", (1.0, 6.0), "weak"),
        ("not identified", (1.0, 20.0), "not identified"),
        ("identified", (1.0, 2.0), "identified"),
    ],
)
def test_a_ratio_is_told_where_it_says_more_than_kilopascals(word, by_ratio, told):
    assert or_as_ratio((word, "why"), by_ratio, at_bound=False)[0] == told


def test_the_same_seed_gives_the_same_statement(inversion, settings, observed, estimation):
    again = stated(inversion, settings, observed)
    assert np.array_equal(again.covariance.total, estimation.covariance.total)


@pytest.fixture(scope="module")
def sampled(inversion, settings, observed):
    return conclude(inversion, settings, observed, truth={}, seed=1, samples=8000)


def test_samples_are_draws_whose_intervals_are_those_of_the_estimate(sampled):
    samples = sampled.samples
    assert (samples.tissues, samples.unit, samples.moduli.shape) == (("gland", "sac"), "kPa", (8000, 2))
    for interval, draws, of in zip(samples.interval95, samples.moduli.T, sampled.estimates, strict=True):
        assert np.mean((draws >= interval[0]) & (draws <= interval[1])) == pytest.approx(0.95, abs=1e-3)
        inside = np.mean((draws >= of.interval95[0]) & (draws <= of.interval95[1]))
        assert inside == pytest.approx(0.95, abs=0.01)
        assert np.median(draws) == pytest.approx(of.value, rel=0.005)


def test_samples_lean_as_the_profile_does_which_no_stretch_of_them_can_make(twins, twin, observed):
    """Of moduli that are known to a factor of two: the end that the objective bends away from lies further off."""
    settings, noise = twins.settings(2.0), NoiseModel(np.array([0.18**2]), np.array([3.0]))
    inversion = invert(twins.exact_problem(twin, noise=noise), settings, progress=twins.silent)
    found = conclude(inversion, settings, observed, truth={}, seed=1, samples=2000)
    leans = []
    for estimate, drawn in zip(found.estimates, found.samples.moduli.T, strict=True):
        low, high = np.quantile(drawn, [0.025, 0.975])
        at, root = np.log(np.array(estimate.profile)[:, 0]), np.array(estimate.profile)[:, 1]
        ends = np.exp(np.interp([-1.96, 1.96], root, at))
        leans.append([np.log(b / estimate.value) / np.log(estimate.value / a) for a, b in ((low, high), ends)])
    ours, profiles = np.log(leans).T
    assert np.abs(profiles).max() > 0.05  # or there would be nothing to show
    assert np.array_equal(np.sign(ours), np.sign(profiles))


def test_the_estimates_do_not_rest_on_the_samples_which_repeat_with_the_seed(
    sampled, estimation, inversion, settings, observed
):
    assert estimation.samples is None
    assert [e.interval95 for e in sampled.estimates] == [e.interval95 for e in estimation.estimates]
    first, second, other = (
        conclude(inversion, settings, observed, truth={}, seed=seed, samples=100).samples.moduli for seed in (1, 1, 2)
    )
    assert np.array_equal(first, second)
    assert not np.array_equal(first, other)


def test_what_did_not_converge_is_not_sampled(inversion, settings, observed):
    ended = replace(inversion, minimum=replace(inversion.minimum, outcome=Outcome.STEPS))
    assert conclude(ended, settings, observed, truth={}, seed=1, samples=100).samples is None


def test_an_interval_of_samples_is_open_where_that_of_the_estimate_is(inversion, settings, estimation):
    posterior = as_stated(inversion, estimation.covariance, settings.bounds)
    marginals = [of.marginal for of in intervals_of(inversion, settings, posterior)]
    ends, given = [(20.0, None), (None, None)], {"draws": 100, "rng": np.random.default_rng(1)}
    found = draw_moduli(inversion.objective.parameters, posterior.mixture, marginals, ends, **given).interval95
    assert np.array_equal(np.isnan(found), [[False, True], [True, True]])


@pytest.mark.parametrize(
    ("interval", "absolute", "word"),
    [
        ((1.0, 4.0), True, "identified"),
        ((1.0, 4.01), True, "weak"),
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


def test_an_interval_that_could_not_be_followed_says_so_and_blames_no_bound(inversion, settings, estimation):
    minimum, covariance = inversion.minimum, estimation.covariance
    frozen = frozen_posterior(inversion.objective, minimum.unknowns, minimum.evaluation)

    posterior = as_stated(inversion, covariance, settings.bounds)
    sd = np.sqrt(np.diag(posterior.covariance))

    @dataclass(frozen=True)
    class Brittle:
        """Solved no further than one and a half standard deviations from the minimum."""

        of: object = frozen

        @property
        def n_parameters(self):
            return self.of.n_parameters

        @property
        def parameters(self):
            return self.of.parameters

        def with_prior(self, parameters):
            return Brittle(self.of.with_prior(parameters))

        def __call__(self, unknowns):
            if np.any(np.abs(unknowns - minimum.unknowns)[:2] > 1.5 * sd):
                raise SolverError("too far")
            return self.of(unknowns)

    assert all(of.followed for of in intervals_of(inversion, settings, posterior))
    lost = profiled(replace(posterior, frozen=Brittle()), settings.bounds)
    known = intervals_of(inversion, settings, lost)
    for found in estimates_of(inversion, known, covariance, truth={}):
        assert found.verdict == "not identified"
        assert found.interval95 is None
        assert "could not be computed" in found.why
        assert "bounds" not in found.why
