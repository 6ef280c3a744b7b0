"""What is stated of an inversion: intervals, verdicts, every start, and never a result that did not converge."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from palpate.images.tissue import Role
from palpate.inversion import Candidate, Inversion, Outcome, OuterIterate, frozen_posterior, gauss_newton, invert
from palpate.inversion.trust_region import Convergence
from palpate.mechanics.forward import SolveCounts
from palpate.observation.noise_model import NoiseModel
from palpate.study.estimation import Observed, conclude
from palpate.study.samples import draw_moduli
from palpate.study.stated_posterior import StatedPosterior
from palpate.study.verdicts import estimates_of, hull, intervals_of, or_as_ratio, verdict
from palpate.uncertainty import (
    FittedState,
    grid_position_shifts,
    mesh_covariance,
    sandwich_covariance,
)
from palpate.uncertainty.covariance import scatter
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


def with_candidate(inversion, number=0, *, value=None, **changes):
    """The inversion with one candidate's minimum, objective or convergence replaced."""
    candidates = list(inversion.candidates)
    now = candidates[number]
    candidates[number] = Candidate(replace(now.iterate, **changes), now.value if value is None else value)
    return replace(inversion, candidates=tuple(candidates))


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
    found = Inversion((Candidate(OuterIterate(objective, minimum), 0.0),), 0, (), minimum.evaluation, 0, SolveCounts())
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
    residuals = sandwich_covariance(inversion.objective, inversion.minimum.evaluation)
    assert np.array_equal(estimation.covariance.total, residuals + mesh_covariance(inversion.objective))


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
    assert outer[-1] == pytest.approx(estimation.estimates[0].value)


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
    ended = spoilt(with_candidate(inversion, minimum=replace(inversion.minimum, outcome=Outcome.STEPS)), Outcome.STEPS)
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
    ended = with_candidate(inversion, minimum=replace(inversion.minimum, outcome=Outcome.STUCK))
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
    unknown = with_candidate(inversion, objective=vague, minimum=minimum)
    found = conclude(unknown, settings, observed, truth={}, seed=1, samples=100)
    verdicts = [e.verdict for e in found.estimates]
    assert "identified" not in verdicts
    assert "not identified" in verdicts
    for estimate, drawn in zip(found.estimates, found.samples.interval95, strict=True):
        assert (estimate.interval95 is None) == (estimate.verdict == "not identified")
        assert (estimate.ratio_interval95 is None) == (estimate.interval95_given_model is None)
        assert estimate.interval95 is not None or np.isnan(drawn).all()


def test_without_a_known_modulus_there_is_no_kpa(twins):
    twin = twins.make_twin(rest_kpa=None)
    settings = twins.settings(1.0)
    inversion = invert(twins.exact_problem(twin, noise=NOISE), settings, progress=twins.silent)
    result = conclude(inversion, settings, observed_of(twin), truth={}, seed=1, samples=100)
    assert [e.tissue for e in result.estimates] == ["sac", "rest"]
    assert (result.samples.tissues, result.samples.unit) == (("sac", "rest"), "ratio")
    assert np.median(result.samples.moduli, axis=(0, 1)) == pytest.approx([2.0 / 3.0, 1.0 / 3.0], rel=0.05)
    for estimate in result.estimates:
        assert (estimate.unit, estimate.relative_to) == ("ratio", "gland")
        assert (estimate.value, estimate.interval95) == (None, None)
        assert estimate.verdict in ("ratio only", "not identified")
    assert [e.ratio for e in result.estimates] == pytest.approx([2.0 / 3.0, 1.0 / 3.0], rel=0.02)
    assert "ratio-only" in codes(result)


def doubled(inversion, **changes):
    """Two candidates, the second start's own with changes of its iterate."""
    first, second = inversion.candidates[0], Candidate(replace(inversion.candidates[0].iterate, **changes), 1e3)
    starts = (inversion.starts[0], replace(inversion.starts[1], candidate=1))
    return replace(inversion, candidates=(first, second), starts=starts)


def test_distinct_minima_are_remarked(estimation, inversion, settings, observed):
    result = stated(doubled(inversion), settings, observed)
    assert "several-minima" in codes(result)
    assert "2 distinct minima" in result.reason
    assert [start.minimum for start in result.starts] == [0, 1]
    assert "several-minima" not in codes(estimation)


def test_a_minimum_without_equilibrium_is_remarked_and_no_minimum_to_compare_with(inversion, settings, observed):
    lost = replace(inversion.minimum, outcome=Outcome.NO_EQUILIBRIUM)
    result = stated(doubled(inversion, minimum=lost), settings, observed)
    assert result.status == "converged"
    assert "no-equilibrium" in codes(result)
    assert "several-minima" not in codes(result)
    assert "1 of which has no equilibrium" in result.reason


def test_an_estimate_whose_outer_loop_ran_out_says_what_is_open(estimation, inversion, settings, observed):
    assert "unsettled" not in codes(estimation)
    out_of_steps = replace(inversion.minimum, outcome=Outcome.STEPS)
    ended = with_candidate(inversion, minimum=out_of_steps, convergence=Convergence(2.0, 0.5, 0.1))
    result = stated(spoilt(ended, Outcome.STEPS), settings, observed)
    (remark,) = (remark for remark in result.remarks if remark.code == "unsettled")
    assert "still moves" in remark.message
    assert "linearised again" not in remark.message
    assert result.status == "not converged"


def with_range(twins, twin, settings, *, sd):
    """The twin's estimate where ln E of the known tissue is believed to be within sd."""
    tissues = tuple(replace(t, modulus_sd=sd * (t.role is Role.KNOWN)) for t in twin.scene.tissues)
    problem = twins.exact_problem(twin, noise=NOISE)
    blocks = (*problem.parameters.blocks, *known_modulus_blocks(tissues, twin.model.regions, (0,)))
    mapping = replace(problem.parameters, blocks=blocks, nuisance_precision=np.zeros((0, 0)))
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


def test_an_interval_that_holds_no_layer_says_so(inversion, settings, observed):
    """Where the estimate with the layers free cannot be followed, or ends before it has converged."""
    best = inversion.candidates[inversion.best].iterate
    open_ = replace(best, minimum=replace(best.minimum, outcome=Outcome.STEPS))
    for released in (None, open_):
        unsettled = replace(inversion.candidates[inversion.best], released=released, unsettled="no equilibrium")
        result = stated(replace(inversion, candidates=(unsettled,), best=0), settings, observed)
        assert result.status == "converged"
        (remark,) = (remark for remark in result.remarks if remark.code == "unsettled")
        assert "layers around organs" in remark.message
        for estimate in result.estimates:
            assert estimate.verdict == "weak"
            assert np.divide(*estimate.interval95[::-1]) < 4.0
            assert "leaves out the effect of layers" in estimate.why


def test_the_same_seed_gives_the_same_statement(inversion, settings, observed, estimation):
    again = stated(inversion, settings, observed)
    assert np.array_equal(again.covariance.total, estimation.covariance.total)


@pytest.fixture(scope="module")
def sampled(inversion, settings, observed):
    return conclude(inversion, settings, observed, truth={}, seed=1, samples=800)


def test_chains_of_samples_agree_and_hold_what_they_state(sampled):
    samples = sampled.samples
    assert (samples.tissues, samples.unit, samples.moduli.shape) == (("gland", "sac"), "kPa", (4, 800, 2))
    assert samples.diagnostics.mixed.all()
    assert np.all((samples.diagnostics.r_hat > 0.99) & (samples.diagnostics.ess_bulk < 3200))
    for interval, draws in zip(samples.interval95, samples.moduli.T, strict=True):
        assert np.mean((draws >= interval[0]) & (draws <= interval[1])) == pytest.approx(0.95, abs=1e-3)


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


def test_chains_that_are_too_short_are_remarked_with_what_to_do(sampled, inversion, settings, observed):
    assert "samples-not-mixed" not in codes(sampled)
    short = conclude(inversion, settings, observed, truth={}, seed=1, samples=100)
    (remark,) = (remark for remark in short.remarks if remark.code == "samples-not-mixed")
    assert "'gland' (R-hat 1." in remark.message
    assert "--samples 400" in remark.message


def test_what_did_not_converge_is_not_sampled(inversion, settings, observed):
    ended = with_candidate(inversion, minimum=replace(inversion.minimum, outcome=Outcome.STEPS))
    assert conclude(ended, settings, observed, truth={}, seed=1, samples=100).samples is None


def test_an_interval_of_samples_is_open_where_that_of_the_estimate_is(inversion, settings):
    given = {"bounds": settings.bounds, "draws": 100, "rng": np.random.default_rng(1)}
    minimum = inversion.minimum
    frozen = frozen_posterior(inversion.objective, minimum.unknowns, minimum.evaluation)
    posterior = StatedPosterior(frozen, minimum, 0.01 * np.eye(2))
    found = draw_moduli(posterior, [(20.0, None), None], **given).interval95
    assert np.array_equal(np.isnan(found), [[False, True], [True, True]])


@pytest.mark.parametrize("level", [0.0, 1e4])
@pytest.mark.parametrize(("worse_by", "counts"), [(0.9, True), (1.1, False)])
def test_another_minimum_is_within_the_interval_if_its_deviance_is_however_large_both_are(
    inversion, settings, observed, estimation, worse_by, counts, level
):
    """Of the interval's own end: what a value is worth does not depend on how many residuals make it up."""
    best, n = inversion.candidates[0], inversion.objective.n_parameters
    own = np.diag(inversion.minimum.evaluation.covariance_columns(n)[:n])
    end = 0.5 * 1.96**2 * (np.diag(estimation.covariance.total) / own)[0]
    far = best.minimum.unknowns + np.append(1.0, np.zeros(len(best.minimum.unknowns) - 1))
    elsewhere = replace(best.iterate, minimum=replace(best.minimum, unknowns=far))
    values = level + np.array([0.0, worse_by * end])
    both = replace(inversion, candidates=(Candidate(best.iterate, values[0]), Candidate(elsewhere, values[1])))
    low, high = stated(both, settings, observed).estimates[0].interval95
    assert low < 30.0
    assert (high > 30.0 * np.e) == counts


def test_a_minimum_that_could_not_be_followed_is_not_said_to_have_no_equilibrium(inversion, settings, observed):
    lost = replace(inversion.minimum, outcome=Outcome.NOT_FOLLOWED)
    result = stated(doubled(inversion, minimum=lost), settings, observed)
    assert "no-equilibrium" not in codes(result)
    assert "equilibrium" not in result.reason
    assert "1 of which could not be followed" in result.reason
    (remark,) = (remark for remark in result.remarks if remark.code == "several-minima")
    assert "1 that could not be followed" in remark.message


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


def test_the_hull_holds_every_interval_and_an_open_end_stays_open():
    assert hull([(2.0, 4.0), (1.0, 3.0)]) == (1.0, 4.0)
    assert hull([(2.0, 4.0), (None, 3.0)]) == (None, 4.0)
    assert hull([(2.0, None)]) == (2.0, None)


def test_an_interval_that_could_not_be_followed_says_so_and_blames_no_bound(inversion, settings, estimation):
    minimum, covariance = inversion.minimum, estimation.covariance
    frozen = frozen_posterior(inversion.objective, minimum.unknowns, minimum.evaluation)

    class Uphill:
        n_parameters = frozen.n_parameters

        def __call__(self, unknowns):
            there = frozen(unknowns)
            return replace(there, score=-100.0 * there.score)

    away = replace(minimum, unknowns=minimum.unknowns + 0.1)
    posteriors = [StatedPosterior(frozen, minimum, covariance.total)]
    assert all(of.followed for of in intervals_of(inversion, settings, posteriors))
    known = intervals_of(inversion, settings, [*posteriors, StatedPosterior(Uphill(), away, covariance.total)])
    for found in estimates_of(inversion, known, covariance, truth={}):
        assert found.verdict == "not identified"
        assert found.interval95 is None
        assert "could not be computed" in found.why
        assert "bounds" not in found.why
