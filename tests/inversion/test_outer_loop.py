"""An estimate is where weights, moduli and model agree: not where one way to it or one saving happens to end."""

from __future__ import annotations

from dataclasses import replace
from itertools import count

import numpy as np
import pytest

from palpate.inversion import (
    Objective,
    Outcome,
    OuterIterate,
    Place,
    exact_approximation,
    fit_coefficients,
    invert,
    reduced_basis,
    reweighted,
    with_first_noise,
)
from palpate.inversion import outer_loop as loop
from palpate.inversion.approximation import Derivatives, ModelError
from palpate.inversion.optimise import posterior_sd
from palpate.inversion.outer_loop import Convergence, Criterion, StopRule, minimised


@pytest.fixture(scope="module")
def found(twins, voxels):
    return invert(voxels, twins.settings(0.5), progress=twins.silent)


@pytest.fixture(scope="module")
def settings_from_far(twins):
    return twins.settings(0.1)


def moved(one, other, rule=None):
    """How far two minima are apart, over the stop rule's tolerance."""
    tolerance = (rule or StopRule()).tolerance(other, 2)
    return float(np.max(np.abs(one.unknowns - other.unknowns)[:2] / tolerance))


@pytest.mark.parametrize("ratio", [1.0, 3.0, 20.0])
def test_the_way_to_the_estimate_does_not_show(twins, voxels, found, ratio):
    """Two ways, each to the tolerance."""
    other = invert(voxels, twins.settings(ratio), progress=twins.silent)
    assert other.convergence.converged
    assert moved(other.minimum, found.minimum) < 2.0


def test_another_pass_of_weights_and_estimate_changes_nothing(twins, found):
    within = StopRule().tolerance(found.minimum, 2) / 6.0
    objective = reweighted(found.objective, found.minimum).rematched(found.minimum.unknowns)
    again = minimised(objective, found.minimum.unknowns, twins.settings(0.5), within=within)
    assert moved(again, found.minimum) < 1.0


def test_the_full_model_finds_the_same_where_the_reduced_one_stands(twins, twin, found):
    """All derivatives of the full model exact, under the weights of the estimate."""
    place = Place(found.objective.parameters.moduli(found.minimum.unknowns), found.minimum.unknowns[2:])
    objective = found.objective.under([exact_approximation(twin.model, None, place)])
    end = minimised(objective, found.minimum.unknowns, twins.settings(0.5), within=1e-5)
    assert moved(end, found.minimum) < 1.0


def test_the_history_is_that_of_the_loop_alone_and_begins_where_a_start_ended(found):
    (start,) = found.starts
    history = found.minimum.history
    assert len(history) > 1
    assert np.array_equal(history[0].theta, start.minimum.unknowns[:2])
    assert not set(map(id, history)) & set(map(id, start.minimum.history))


def test_where_the_reach_cuts_the_step_short_nothing_is_reweighted(twins, twin, settings_from_far):
    """What is still motion would pass for noise."""
    problem = twins.exact_problem(twin)
    unknowns = np.concatenate([settings_from_far.starts[0], np.zeros(len(twin.coefficients))])
    at_rest = exact_approximation(twin.model, None, Place(problem.parameters.moduli(unknowns), unknowns[2:]))
    objective = with_first_noise(Objective(problem.states, problem.parameters).under([at_rest])).rematched(unknowns)
    filled = fit_coefficients(objective, unknowns, bounds=settings_from_far.bounds)
    exact = at_rest.update(*objective.places(filled.unknowns))  # a body at rest shows no modulus
    objective = objective.under([exact]).rematched(filled.unknowns)
    start = OuterIterate(objective, replace(filled, evaluation=objective(filled.unknowns)))
    one = StopRule(iterations=1)
    end = loop.run_outer_loop(start, settings_from_far, one, progress=twins.silent, title="")
    assert np.abs(end.minimum.unknowns - unknowns)[:2].max() == pytest.approx(exact.reach)
    assert end.objective.states[0].noise == objective.states[0].noise
    assert Criterion.REWEIGHTING in end.convergence.unmet
    end = loop.run_outer_loop(start, settings_from_far, StopRule(), progress=twins.silent, title="")
    assert end.minimum.unknowns[:2] == pytest.approx(twins.TRUTH, abs=1e-4)


def test_a_prior_that_follows_the_estimate_is_held_from_where_that_is_near(twins, voxels, monkeypatch):
    """Learned anew at every step it went on: the wall slid off along itself, and took the moduli with it."""
    learned, asked = [], []

    def wider(objective, *_):
        asked.append(1)
        if objective.prior_held:
            return objective
        learned.append(0.7 * objective.parameters.nuisance_precision)
        return replace(objective, parameters=replace(objective.parameters, nuisance_precision=learned[-1]))

    monkeypatch.setattr("palpate.inversion.estimate.with_learned_prior", lambda objective, *_: objective)
    monkeypatch.setattr("palpate.inversion.reweighting.with_learned_prior", wider)
    found = invert(voxels, twins.settings(0.5), progress=twins.silent)
    assert found.convergence.converged
    assert 0 < len(learned) < len(asked)
    assert np.array_equal(found.objective.parameters.nuisance_precision, learned[-1])
    assert not found.objective.prior_held


def test_what_has_converged_is_not_given_up_for_another_prior_in_the_last_iterations(twins, voxels, monkeypatch):
    asked = []
    monkeypatch.setattr(loop, "_prior_holds", lambda *_: asked.append(1) or True)
    found = invert(voxels, twins.settings(0.5), progress=twins.silent, rule=StopRule(iterations=loop.AFTER_CHANGE))
    assert found.minimum.converged
    assert not asked
    invert(voxels, twins.settings(0.5), progress=twins.silent)
    assert asked


def test_a_prior_that_was_held_too_early_is_learned_once_more(twins, voxels, monkeypatch):
    """Held while it pulled the coefficient to nothing: at the estimate that it leads to it says something else."""
    learning, times_held = loop._learning, []

    def noted(now, *, held, **last):
        times_held.extend([1] if held else [])
        return learning(now, held=held, **last)

    def too_narrow_at_first(objective, *_):
        if objective.prior_held:
            return objective
        precision = np.full_like(objective.parameters.nuisance_precision, 1e-6 if times_held else 1e5)
        return replace(objective, parameters=replace(objective.parameters, nuisance_precision=precision))

    monkeypatch.setattr(loop, "_learning", noted)
    monkeypatch.setattr("palpate.inversion.estimate.with_learned_prior", lambda objective, *_: objective)
    monkeypatch.setattr("palpate.inversion.reweighting.with_learned_prior", too_narrow_at_first)
    twice = invert(voxels, twins.settings(0.5), progress=twins.silent)
    assert len(times_held) == 1 + loop.RELEARNED
    from_the_start = invert(voxels, twins.settings(0.5), progress=twins.silent).minimum  # it has been held before
    times_held.clear()
    monkeypatch.setattr(loop, "RELEARNED", 0)
    once = invert(voxels, twins.settings(0.5), progress=twins.silent)
    assert len(times_held) == 1
    off = [found.minimum.unknowns[:2] - from_the_start.unknowns[:2] for found in (twice, once)]
    apart = [np.abs(of / posterior_sd(from_the_start, 2)).max() for of in off]
    assert apart[0] < 0.05 < apart[1]


def test_weights_that_never_agree_are_not_called_convergence(twins, voxels, monkeypatch):
    """Three sets of weights in turn: a loop of three passes ends where it began, and still nothing agrees."""
    passes = count()

    def in_turn(objective, minimum):
        first, *others = reweighted(objective, minimum).observations
        times = (1.0, 9.0, 81.0)[next(passes) % 3]
        weighting = replace(first.weighting, precision=times * first.weighting.precision)
        return objective.with_observations([replace(first, weighting=weighting), *others])

    monkeypatch.setattr(loop, "reweighted", in_turn)
    rule = StopRule(passes=3, iterations=4)
    found = invert(voxels, twins.settings(0.5), progress=twins.silent, rule=rule)
    assert Criterion.REWEIGHTING in found.convergence.unmet
    assert found.convergence.reweighting > loop.StopRule().far
    assert found.minimum.outcome is Outcome.STEPS


def test_a_model_that_is_not_exact_enough_at_the_last_iteration_is_not_called_convergence(twins, voxels):
    """One that is never made exact, beside a demand that it cannot meet."""
    rule = StopRule(model_error=1e-12, solve_above=np.inf, iterations=4, derivatives=False)
    found = invert(voxels, twins.settings(0.5), progress=twins.silent, rule=rule)
    assert found.convergence.model_error > rule.far
    assert max(found.convergence.reweighting, found.convergence.linearisation) < rule.far
    assert found.minimum.outcome is Outcome.STEPS


def test_weights_that_take_turns_within_the_noise_end_an_estimate(twins, voxels, monkeypatch):
    """Two sets of weights, each of which asks for the other: an iteration of two passes ends where it began."""
    passes, agreed = [], loop._agreed

    def counted(*arguments):
        passes.append(len(passes))
        return agreed(*arguments)

    def in_turn(objective, minimum):
        first, *others = reweighted(objective, minimum).observations
        times = 1.0 if len(passes) % 2 else 1.4
        weighting = replace(first.weighting, precision=times * first.weighting.precision)
        return objective.with_observations([replace(first, weighting=weighting), *others])

    monkeypatch.setattr(loop, "_agreed", counted)
    monkeypatch.setattr(loop, "reweighted", in_turn)
    end = invert(voxels, twins.settings(0.5), progress=twins.silent, rule=StopRule(passes=2))
    assert end.convergence.converged
    assert len(passes) < 2 * StopRule().iterations


@pytest.mark.parametrize(("damped_after", "settles"), [(loop.DAMPED_AFTER, True), (99, False)])
def test_passes_that_go_to_and_fro_settle_half_way(twins, found, monkeypatch, damped_after, settles):
    """Each leads as far beyond the place where weights and estimate agree as it began before it."""
    there = found.minimum.unknowns

    def beyond(objective, minimum, *_):
        return objective, replace(minimum, unknowns=2.0 * there - minimum.unknowns), 0.0

    def advanced(objective, minimum, aim, _):
        return objective, replace(minimum, unknowns=aim)

    monkeypatch.setattr(loop, "_agreed", beyond)
    monkeypatch.setattr(loop, "_advanced", advanced)
    monkeypatch.setattr(loop, "DAMPED_AFTER", damped_after)
    before = replace(found.minimum, unknowns=there + np.eye(len(there))[0] * 0.1)
    now = OuterIterate(found.objective, before, step=1.0)
    _, end, change = loop._reweighted_minimum(now, twins.settings(0.5), StopRule(), twins.silent, "")
    assert (change < 1.0 and moved(end, found.minimum) < 1e-6) == settles


@pytest.mark.parametrize(("turned", "settles"), [(loop.TURNED, True), (99.0, False)])
def test_outer_iterations_that_go_to_and_fro_settle_half_way(twins, found, monkeypatch, turned, settles):
    """The approximation at either end leads to the other."""
    there = found.minimum.unknowns

    def beyond(now, *_):
        aim = 2.0 * there - now.minimum.unknowns
        return now.objective, replace(now.minimum, unknowns=aim, evaluation=now.objective(aim)), 0.0

    monkeypatch.setattr(loop, "_reweighted_minimum", beyond)
    monkeypatch.setattr(loop, "TURNED", turned)
    away = there + np.eye(len(there))[0] * 0.1
    before = replace(found.minimum, unknowns=away, evaluation=found.objective(away))
    start, silent = OuterIterate(found.objective, before), twins.silent
    end = loop.run_outer_loop(start, twins.settings(0.5), StopRule(), progress=silent, title="")
    assert end.minimum.converged == settles
    assert (moved(end.minimum, found.minimum) < 1e-6) == settles


def test_every_criterion_must_hold():
    met = Convergence(0.9, 0.9, 0.9)
    assert met.converged
    assert met.unmet == ()
    for name in ("reweighting", "linearisation", "model_error"):
        (criterion,) = replace(met, **{name: 1.0}).unmet
        assert criterion is Criterion[name.upper()]
    assert Convergence().unmet == tuple(Criterion)


def test_an_estimate_may_move_by_a_share_of_its_own_uncertainty_but_not_without_end(found):
    sd = posterior_sd(found.minimum, 2)
    assert StopRule(step_sd=0.1, floor=0.0).tolerance(found.minimum, 2) == pytest.approx(0.1 * sd)
    assert StopRule(step_sd=0.0, floor=0.01).tolerance(found.minimum, 2).tolist() == [0.01, 0.01]


def test_what_an_approximation_misses_is_told_by_how_far_it_sets_the_moduli_off(twins, twin, voxels):
    """H^-1 J^T W (r - r_approximate) with the full model's residuals r, from one right-hand side, to a tenth."""
    crude = reduced_basis(twin.model, np.exp([0.3, -0.2, 0.0]) * twin.moduli)
    objective = twins.objective_of(voxels, twin.coefficients).under([crude]).rematched(twin.unknowns)
    here = minimised(objective, twin.unknowns, twins.settings(1.0), within=1e-3)
    error, off, _ = loop._model_error(objective, here)
    place = Place(objective.parameters.moduli(here.unknowns), here.unknowns[2:])
    full = objective.under([exact_approximation(twin.model, None, place)])(here.unknowns)
    pull = np.zeros(len(here.unknowns))
    for line, exact in zip(here.evaluation.lines, full.lines, strict=True):
        change = exact.residuals.values - line.residuals.values
        pull[line.columns] += line.jacobian.transposed_times(line.precision * line.weights * change)
    true = np.abs(here.evaluation.covariance_columns(2).T @ pull)
    assert error > 1e-3
    assert true.max() > 1e-3
    assert off == pytest.approx(true, abs=0.1 * true.max())


def test_an_approximation_that_cannot_say_what_it_misses_leaves_everything_open(twins, twin, voxels, monkeypatch):
    basis = reduced_basis(twin.model, twin.moduli)
    objective = twins.objective_of(voxels, twin.coefficients).under([basis]).rematched(twin.unknowns)
    here = minimised(objective, twin.unknowns, twins.settings(1.0))
    silent = ModelError(np.inf, np.zeros(0))
    monkeypatch.setattr(type(basis), "error", lambda _self, _at: silent)
    error, off, _ = loop._model_error(objective, here)
    assert error == np.inf
    assert off.tolist() == [np.inf, np.inf]


@pytest.mark.parametrize(
    ("error", "share", "above", "forward"),
    [(0.02, 0.5, 0.0, 1), (0.02, 1e-5, 0.0, 0), (0.2, 0.5, 0.3, 0), (0.4, 0.5, 0.3, 1)],
)
def test_a_loop_begins_on_a_model_that_is_exact_there_unless_its_rule_asks_for_less(
    twins, twin, voxels, monkeypatch, error, share, above, forward
):
    """What an approximation misses passes for noise, and the loop may keep to the weights that follow.

    A share of the displacement that moves no modulus by a tenth of its standard deviation is nothing to the noise.
    """
    objective = twins.objective_of(voxels, twin.coefficients).rematched(twin.unknowns)
    start = minimised(objective, twin.unknowns, twins.settings(1.0))
    basis = objective.states[0].approximation
    told = ModelError(error, share * twin.scene.displacement.ravel())
    monkeypatch.setattr(type(basis), "error", lambda _self, _at: told)
    found = loop.updated(objective, start, StopRule(solve_above=above))
    assert found.objective.states[0].approximation.counts.forward == basis.counts.forward + forward


def test_derivatives_that_are_exact_nowhere_leave_everything_open(found):
    state, minimum = found.objective.states[0], found.minimum
    basis, sd = state.approximation, posterior_sd(minimum, 2)
    here = Place(found.objective.parameters.moduli(minimum.unknowns), minimum.unknowns[2:], np.eye(3, 1), np.eye(3))

    def left(place):
        return loop._linearisation(found.objective.under([replace(basis, place=place)]), minimum)

    assert np.all(left(None) == np.inf)
    assert np.all(left(replace(here, directions=None)) == np.inf)
    assert left(here) == pytest.approx(0.0, abs=1e-12)
    apart = replace(here, moduli=here.moduli * np.exp([0.1, 0.0, 0.0]))
    assert left(apart) == pytest.approx(0.1 * np.maximum(sd, 0.03))


def test_a_step_on_a_model_that_is_far_off_is_taken_only_as_far_as_it_lowers_the_objective(
    twins, twin, voxels, monkeypatch
):
    """The first half of the way: the whole is said to lead uphill by the full model."""
    asked = []

    def second_is_lower(_now, _there, step):
        asked.append(step)
        return len(asked) == 2

    monkeypatch.setattr(loop, "_lowers", second_is_lower)
    there = step_of(twins, twin, voxels)
    before = replace(there, minimum=replace(there.minimum, unknowns=there.minimum.unknowns + 0.1))
    reached = loop._line_search(before, there, Derivatives.KEPT)
    assert reached.minimum.unknowns == pytest.approx(before.minimum.unknowns - 0.05)
    assert not reached.stayed
    assert asked[0] == pytest.approx(2.0 * asked[1])


@pytest.mark.parametrize(("step", "outcome"), [(0.5, Outcome.STALLED), (2.0, Outcome.STUCK)])
def test_where_no_part_of_a_step_lowers_the_objective_the_estimate_stays(
    twins, twin, voxels, monkeypatch, step, outcome
):
    monkeypatch.setattr(loop, "_lowers", lambda *_: False)
    there = replace(step_of(twins, twin, voxels), step=step)
    before = replace(there, minimum=replace(there.minimum, unknowns=there.minimum.unknowns + 0.1))
    stayed = loop._line_search(before, there, Derivatives.KEPT)
    assert np.array_equal(stayed.minimum.unknowns, before.minimum.unknowns)
    assert stayed.stayed
    assert stayed.minimum.outcome is outcome


def step_of(twins, twin, voxels):
    """An iterate on a reduced basis, as a step has led to it."""
    objective = twins.objective_of(voxels, twin.coefficients).rematched(twin.unknowns)
    return OuterIterate(objective, minimised(objective, twin.unknowns, twins.settings(1.0)))
