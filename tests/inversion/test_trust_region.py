"""One loop lowers one objective: whatever the way, the approximation and the noise of closest points."""

from __future__ import annotations

from dataclasses import fields, replace
from itertools import count

import numpy as np
import pytest

from palpate.approximation import LinearisationPoint, ReducedBasis, exact_approximation, reduced_basis
from palpate.approximation.contract import ModelError
from palpate.errors import NotConverged
from palpate.inversion import (
    LinearisedObjective,
    Objective,
    Outcome,
    StopRule,
    begun,
    fit_coefficients,
    invert,
    minimised,
    posterior_sd,
    trust_region,
    with_first_noise,
)
from palpate.inversion.optimise import RADIUS, TRIALS, TrustRegion, newton_decrement
from palpate.inversion.trust_region import Convergence, Criterion, total_counted_as
from palpate.observation.noise_model import NoiseModel
from palpate.unknowns import layer_blocks

CHEAP = StopRule(model_error=np.inf, derivatives=False)


@pytest.fixture(scope="module")
def found(twins, voxels):
    return invert(voxels, twins.settings(0.5), progress=twins.silent)


def end_of(found):
    return found.candidates[found.best].iterate


def moved(one, other, rule=None):
    """How far two minima are apart, over the stop rule's tolerance."""
    tolerance = (rule or StopRule()).tolerance(other, 2)
    return float(np.max(np.abs(one.unknowns - other.unknowns)[:2] / tolerance))


def on(found, objective, twins, rule=None, **changes):
    """The loop from where an estimate ended, on another objective."""
    start = replace(begun(objective, found.minimum.unknowns), **changes)
    return minimised(start, twins.settings(0.5).bounds, rule or StopRule(), progress=twins.silent, title="")


@pytest.mark.parametrize("ratio", [1.0, 3.0, 20.0])
def test_the_way_to_the_estimate_does_not_show(twins, voxels, found, ratio):
    """Two ways, each to the tolerance; the hyper-parameters end alike, too."""
    other = invert(voxels, twins.settings(ratio), progress=twins.silent)
    assert other.convergence.converged
    assert moved(other.minimum, found.minimum) < 2.0
    scales = [[o.weighting.sd for o in f.objective.observations] for f in (found, other)]
    assert scales[0] == pytest.approx(scales[1], rel=5e-3)


def test_which_alternative_is_chosen_does_not_hang_on_the_way(twins, found):
    """Of two that are nearly alike the likelier one, whichever was chosen before, or none."""
    coefficients, ends = found.minimum.unknowns[2:], list[tuple[int | None, ...]]()
    size = float(np.sqrt(np.mean(coefficients**2)))
    objective = twins.mixture(end_of(found).objective, (size, 1.05 * size))
    for before in ((), (0,), (1,)):
        end = on(found, replace(objective, chosen=before), twins, CHEAP)
        assert end.minimum.converged
        ends.append(end.objective.chosen)
    assert len(set(ends)) == 1


def test_what_is_learned_last_has_its_choice_where_an_estimate_ends(twins, found):
    """Also where that is the first alternative: it would else stay as wide as it was believed to be until then."""
    coefficients = found.minimum.unknowns[2:]
    size, n = float(np.sqrt(np.mean(coefficients**2))), len(coefficients)
    objective = twins.mixture(end_of(found).objective, (size, 20.0 * size), last=True)
    wide = replace(objective.parameters, nuisance_precision=np.eye(n) / (20.0 * size) ** 2)
    end = on(found, replace(objective, parameters=wide), twins, CHEAP)
    assert end.minimum.converged
    assert end.objective.chosen == (0,)
    assert end.objective.parameters.nuisance_precision == pytest.approx(np.eye(n) / size**2, rel=0.01)


def test_alternatives_that_lead_to_others_without_end_leave_the_last_minimum(twins, found, monkeypatch):
    chosen_afresh, number = trust_region._chosen_afresh, count(1)

    def anew(now):
        return replace(chosen_afresh(now), objective=replace(now.objective, chosen=(next(number),)))

    monkeypatch.setattr(trust_region, "_chosen_afresh", anew)
    end = on(found, found.objective, twins, replace(StopRule(), iterations=6))
    assert end.minimum.converged
    assert next(number) > 2
    assert moved(end.minimum, found.minimum) < 1.0


def far_away(now):
    """Five standard deviations off, under an alternative that no block has had."""
    sd = posterior_sd(now.minimum, 2)
    away = now.minimum.unknowns + 5.0 * np.concatenate([sd, np.zeros(now.objective.parameters.n_coefficients)])
    return replace(begun(replace(now.objective, chosen=(7,)), away), totals=now.totals)


def test_a_minimum_is_not_lost_by_alternatives_that_lead_to_none(twins, found, monkeypatch):
    """What is chosen afresh lies far away, and the iterations end before it is a minimum."""

    monkeypatch.setattr(trust_region, "_chosen_afresh", far_away)
    end = on(found, found.objective, twins, replace(StopRule(), iterations=2))
    assert end.minimum.outcome is Outcome.CONVERGED
    assert moved(end.minimum, found.minimum) < 1.0


def test_alternatives_that_do_not_lower_the_objective_in_some_iterations_are_given_up(twins, found, monkeypatch):
    """As where a step far away brings ever more, and the minimum that was found is likelier."""
    iteration, numbers = trust_region._iteration, count(1)

    def without_end(now, bounds, rule, region, *others, **named):
        if next(numbers) == 1:
            return iteration(now, bounds, rule, region, *others, **named)
        return replace(now, convergence=Convergence(step=9.0)), region

    monkeypatch.setattr(trust_region, "_iteration", without_end)
    monkeypatch.setattr(trust_region, "_chosen_afresh", far_away)
    end = on(found, found.objective, twins)
    assert next(numbers) == 1 + trust_region.TRIED + 1
    assert end.minimum.converged
    assert moved(end.minimum, found.minimum) < 1.0


def test_of_minima_under_other_alternatives_the_likeliest_is_told_whatever_their_order(found):
    end = end_of(found)
    worse = end.minimum.unknowns + 3.0 * posterior_sd(found.minimum, 2)[0] * np.eye(len(end.minimum.unknowns))[0]
    other = begun(end.objective, worse)
    for ends in ((end, other), (other, end)):
        assert np.array_equal(trust_region._likeliest(ends, ends[-1]).minimum.unknowns, end.minimum.unknowns)
        assert trust_region._likeliest(ends, ends[-1]).minimum.evaluations == ends[-1].minimum.evaluations


@pytest.mark.parametrize("of", ["value", "score"])
def test_alternatives_stay_where_the_objective_rises_by_what_was_promised_of_others(twins, found, monkeypatch, of):
    """Linear residuals promise of them what does not hold where they lead: the step is taken without."""
    size = float(np.sqrt(np.mean(found.minimum.unknowns[2:] ** 2)))
    objective = replace(twins.mixture(end_of(found).objective, (size, 20.0 * size)), chosen=(1,))
    assert on(found, objective, twins, CHEAP).objective.chosen == (0,)
    evaluated = trust_region._evaluated

    def rises(step, now, *others):
        there, spent = evaluated(step, now, *others)
        if step.objective.chosen == now.objective.chosen:
            return there, spent
        seen = there.minimum.evaluation
        uphill = replace(seen, score=seen.score + 1e12 * (there.minimum.unknowns - now.minimum.unknowns))
        higher = replace(seen if of == "value" else uphill, value=seen.value + 1e3)
        return replace(there, minimum=replace(there.minimum, evaluation=higher)), spent

    monkeypatch.setattr(trust_region, "_evaluated", rises)
    end = on(found, objective, twins, replace(CHEAP, iterations=1))
    assert end.objective.chosen == (1,)
    assert len(end.totals) == 1


def test_a_first_choice_that_does_not_hold_where_it_leads_is_put_off_and_no_step_shortened(twins, found, monkeypatch):
    """Before it priors are not those of J: a loop would go on in steps of the size that the choice allows."""
    size, sd = float(np.sqrt(np.mean(found.minimum.unknowns[2:] ** 2))), posterior_sd(found.minimum, 2)
    objective = replace(twins.mixture(end_of(found).objective, (size, 20.0 * size)), chosen=())
    away = found.minimum.unknowns + 0.5 * np.append(sd, np.zeros(len(found.minimum.unknowns) - 2))
    evaluated, bounds = trust_region._evaluated, twins.settings(0.5).bounds

    def rises(step, now, *others):
        there, spent = evaluated(step, now, *others)
        if step.objective.chosen == now.objective.chosen:
            return there, spent
        seen = there.minimum.evaluation
        uphill = replace(seen, score=seen.score + 1e12 * (there.minimum.unknowns - away), value=seen.value + 1e3)
        return replace(there, minimum=replace(there.minimum, evaluation=uphill)), spent

    monkeypatch.setattr(trust_region, "_evaluated", rises)
    ends = [
        minimised(
            begun(objective, away), bounds, replace(CHEAP, iterations=1, learn=learn), progress=twins.silent, title=""
        )
        for learn in (True, False)
    ]
    assert ends[0].objective.chosen == ()
    assert np.array_equal(ends[0].minimum.unknowns, ends[1].minimum.unknowns)


def test_no_accepted_step_raises_the_objective(twins, twin, voxels):
    """But for the noise of closest points; all of them together lower it."""
    objective = with_first_noise(twins.objective_of(voxels, twin.coefficients))
    for ratio in (0.2, 30.0):
        start = begun(objective, np.concatenate([np.log([ratio, ratio]), twin.coefficients]))
        end = minimised(start, twins.settings(ratio).bounds, StopRule(), progress=twins.silent, title="")
        steps = np.array(end.totals)
        assert len(steps) > 1
        assert np.all(steps[:, 1] < steps[:, 0] + trust_region.NOISE)
        assert np.sum(steps[:, 1] - steps[:, 0]) < -trust_region.NOISE


def test_where_it_ends_the_objective_is_least_along_every_log_modulus(found):
    """With all other unknowns and the hyper-parameters at their best on linear residuals."""
    end = end_of(found)
    linear = LinearisedObjective(end.objective, end.minimum.unknowns, end.minimum.evaluation)
    here = linear(end.minimum.unknowns)
    shift = np.linalg.solve(here.matrix, here.score)
    assert np.all(np.abs(shift[:2]) < 0.1 * posterior_sd(found.minimum, 2))


def test_going_on_from_the_estimate_changes_nothing(twins, found):
    again = on(found, found.objective, twins)
    assert again.minimum.converged
    assert moved(again.minimum, found.minimum) < 1.0


def test_the_full_model_finds_the_same_where_the_reduced_one_stands(twins, twin, found):
    """All derivatives of the full model exact at every place."""
    place = LinearisationPoint(found.objective.parameters.moduli(found.minimum.unknowns), found.minimum.unknowns[2:])
    end = on(found, found.objective.under([exact_approximation(twin.model, None, place)]), twins)
    assert end.minimum.converged
    assert moved(end.minimum, found.minimum) < 1.0


def test_where_the_trust_region_cuts_a_step_short_no_hyper_parameter_moves(twins, twin):
    """What is still motion would pass for noise."""
    problem, settings = twins.exact_problem(twin), twins.settings(0.1)
    unknowns = np.concatenate([settings.starts[0], np.zeros(len(twin.coefficients))])
    basis = twins.objective_of(problem, twin.coefficients)
    filled = fit_coefficients(with_first_noise(basis), unknowns)
    start = begun(with_first_noise(basis), filled.unknowns)
    one = minimised(start, settings.bounds, replace(CHEAP, iterations=1), progress=twins.silent, title="")
    assert np.abs(one.minimum.unknowns - filled.unknowns)[:2].max() == pytest.approx(0.5 * RADIUS)
    assert one.objective.states[0].noise == start.objective.states[0].noise
    assert Criterion.STEP in one.convergence.unmet
    assert one.minimum.outcome is Outcome.STEPS
    end = minimised(start, settings.bounds, StopRule(), progress=twins.silent, title="")
    assert end.minimum.unknowns[:2] == pytest.approx(twins.TRUTH, abs=1e-4)


def test_a_step_promises_by_the_scores_and_gains_by_them_or_by_the_objective_itself(found):
    """A score that changes unevenly along a long way tells too little; the objective itself, where it is rough."""
    end = end_of(found)
    here, n = end.minimum.unknowns, end.objective.parameters.n_coefficients
    unknowns = here + 4.0 * np.concatenate([posterior_sd(found.minimum, 2), np.zeros(n)])
    linear = LinearisedObjective(end.objective, unknowns, end.objective(unknowns))
    begin, reached = linear(unknowns), linear(here)
    step = trust_region._Step(end.objective, replace(end.minimum, evaluation=reached), begin, 0.0, 0.0, False, False)
    gain, promised = step.reductions(unknowns, reached)
    assert gain == pytest.approx(promised)
    steeper = replace(reached, score=3.0 * np.abs(begin.score) * np.sign(here - unknowns))
    assert step.reductions(unknowns, steeper)[0] == pytest.approx(begin.value - reached.value)
    higher = replace(reached, value=begin.value + 1.0)
    assert step.reductions(unknowns, higher) == pytest.approx((promised, promised))


def test_a_step_that_the_trust_region_cuts_ends_no_estimate(twins, found, monkeypatch):
    """It is short for another reason than that the minimum is near: 0.3 standard deviations, 15 tolerances, away."""
    end, sd = end_of(found), posterior_sd(found.minimum, 2)
    monkeypatch.setattr(trust_region, "TrustRegion", lambda: TrustRegion(radius=1e-3 * float(sd.min())))
    away = end.minimum.unknowns + 0.3 * np.concatenate([sd, np.zeros(end.objective.parameters.n_coefficients)])
    assert newton_decrement(end.objective(away)) < trust_region.NOISE
    back = minimised(
        begun(end.objective, away), twins.settings(0.5).bounds, StopRule(), progress=twins.silent, title=""
    )
    assert back.minimum.converged
    assert moved(back.minimum, found.minimum) < 2.0


@pytest.mark.parametrize(("ends_at", "fell", "counts"), [(0.5, True, True), (0.5, False, False), (1.5, False, True)])
def test_where_the_score_leads_on_and_the_objective_is_no_lower_a_step_tells_nothing(
    twins, found, ends_at, fell, counts
):
    """As where normals are wrong alike wherever a wall lies: it slides on, and no residual changes as they promise.

    Not so where the objective falls, nor beyond the minimum, where the score leads back.
    """
    end = end_of(found)
    away = np.append(posterior_sd(found.minimum, 2), np.zeros(end.objective.parameters.n_coefficients))
    begin = begun(end.objective, end.minimum.unknowns + away)
    arrived = begun(end.objective, end.minimum.unknowns + (1.0 - ends_at) * away).minimum
    step = trust_region._Step(
        end.objective,
        arrived,
        begin.minimum.evaluation,
        now=np.inf if fell else -np.inf,
        then=0.0,
        cut=False,
        settled=False,
    )
    bounds = twins.settings(0.5).bounds
    there, _ = trust_region._evaluated(step, begin, bounds, replace(CHEAP, floor=0.0))
    whole = ends_at / CHEAP.step_sd
    assert there.convergence.step == pytest.approx(whole, rel=0.1) if counts else there.convergence.step < 0.1 * whole


@pytest.mark.parametrize("radius", [0.02, 0.1])
def test_no_step_of_what_acts_on_moduli_is_longer_than_the_trust_radius(twins, twin, found, monkeypatch, radius):
    """A layer's stiffness leads as far from where the model is exact as a modulus does."""
    tissues, regions = twin.scene.tissues, end_of(found).objective.states[0].model.regions
    own = tuple(
        i for i, number in enumerate(regions) if tissues[number].name == end_of(found).objective.parameters.tissues[0]
    )
    objective = end_of(found).objective
    blocks = (*objective.parameters.blocks, *layer_blocks((("layer", own, 1.0),), (0,), sd=1.0, thickness_mm=0.5))
    parameters = replace(objective.parameters, blocks=blocks, nuisance_precision=np.zeros((0, 0))).released()
    objective = replace(objective, parameters=parameters, chosen=())
    away = np.append(found.minimum.unknowns, -1.0)
    monkeypatch.setattr(trust_region, "TrustRegion", lambda: TrustRegion(radius=radius))
    one = minimised(
        begun(objective, away),
        twins.settings(0.5).bounds,
        replace(CHEAP, iterations=1),
        progress=twins.silent,
        title="",
    )
    moduli = np.append(np.arange(2), parameters.acting_on_moduli)
    assert len(moduli) == 3
    assert np.abs(one.minimum.unknowns - away)[moduli].max() == pytest.approx(radius, rel=1e-6)
    assert Criterion.STEP in one.convergence.unmet


@pytest.mark.parametrize("ratio", [0.5, 12.0])
def test_a_step_longer_than_a_standard_deviation_tells_no_number_of_independent_residuals(twins, twin, voxels, ratio):
    """What it leaves is motion, alike over whole surfaces: it would pass for one residual a surface."""
    objective = with_first_noise(twins.objective_of(voxels, twin.coefficients))
    begin = np.concatenate([np.log([ratio, ratio]), twin.coefficients])
    bounds = twins.settings(0.5).bounds
    first = [o.weighting.count for o in begun(objective, begin).objective.observations]
    counts, long = [first], []
    for iterations in range(1, 6):
        rule = replace(CHEAP, iterations=iterations)
        end = minimised(begun(objective, begin), bounds, rule, progress=twins.silent, title="")
        way = [iterate.theta for iterate in end.minimum.history]
        if len(way) <= iterations:
            break
        long.append(bool(np.any(np.abs(way[-1] - way[-2]) >= posterior_sd(end.minimum, 2))))
        counts.append([o.weighting.count for o in end.objective.observations])
    assert long[0]
    assert not all(long)
    for before, after, was_long in zip(counts, counts[1:], long, strict=False):
        assert after == before or not was_long
    assert counts[-1] != first


@pytest.mark.parametrize("seed", range(1, 7))
def test_independent_residuals_are_counted_before_an_alternative_is_chosen(twins, twin, seed):
    """A wall that moves as smooth noise does explains it: by those of exact surfaces it would gain too much.

    Also where the trust region cuts the step; of alternatives that have no choice yet nothing is counted there.
    """
    noisy = twins.noisy_problem(twin, sd_mm=0.4, seed=seed)
    begin, bounds = np.concatenate([np.log([12.0, 12.0]), twin.coefficients]), twins.settings(0.5).bounds
    objective, rough = twins.objective_of(noisy, twin.coefficients), NoiseModel(np.array([0.4**2]), np.array([0.5]))
    objective = objective.with_observations([o.with_correlation(rough) for o in objective.observations])
    first, chosen, waits = (
        begun(twins.mixture(objective, (1.0, 3.0), last=last), begin) for last in (False, False, True)
    )
    chosen = replace(chosen, objective=replace(chosen.objective, chosen=(0,)))
    for start, counted in ((first, True), (chosen, False), (waits, False)):
        step = trust_region._linear_minimum(start, bounds, CHEAP, TrustRegion(radius=0.01))
        assert step.cut
        before, after = (of.objective.n_independent for of in (start, step))
        assert after < 0.1 * before if counted else after == before


def test_minima_are_compared_by_the_numbers_of_independent_residuals_of_the_one_that_has_the_fewest(found):
    """Of those that converged. Here nothing differs but they: compared each by its own, one would seem likelier."""
    end = end_of(found)
    fewer = [
        o.with_correlation(replace(o.noise_model, lengths=1.4 * o.noise_model.lengths))
        for o in end.objective.observations
    ]
    few = replace(end, objective=end.objective.with_observations(fewer))
    assert few.objective.n_independent < 0.6 * end.objective.n_independent
    assert trust_region.with_fewest([end, few]) is few
    assert total_counted_as(end, few) == pytest.approx(total_counted_as(few, few))
    assert abs(total_counted_as(end, end) - total_counted_as(few, few)) > 1.0
    stopped = replace(few, minimum=replace(few.minimum, outcome=Outcome.STEPS))
    assert trust_region.with_fewest([end, stopped]) is end
    assert trust_region.with_fewest([stopped]) is stopped


def test_bounds_hold_and_what_they_hold_back_is_a_minimum(twins, voxels):
    narrow = twins.settings(1.0, limits=(0.5, 2.0))
    found = invert(voxels, narrow, progress=twins.silent)
    assert found.minimum.converged
    assert narrow.bounds.reached(found.minimum.unknowns[:2]).any()


def test_log_moduli_that_are_held_stay(twins, twin, voxels):
    objective = twins.objective_of(voxels, twin.coefficients)
    unknowns = np.append([0.3, 0.1], np.zeros(len(twin.coefficients)))
    fitted = fit_coefficients(objective, unknowns)
    assert fitted.converged
    assert np.array_equal(fitted.unknowns[:2], unknowns[:2])
    assert objective.rematched(fitted.unknowns)(fitted.unknowns).value < 0.2 * objective(unknowns).value


def test_a_step_that_raises_the_objective_is_refused_and_a_shorter_one_taken(twins, twin, voxels, monkeypatch):
    """The first trial is said to lead uphill; where every one does, it is no minimum."""
    objective, bounds = twins.objective_of(voxels, twin.coefficients), twins.settings(1.0).bounds
    start = begun(objective, np.append([0.0, 0.0], twin.coefficients))
    evaluated, refused = trust_region._evaluated, []

    def uphill(times):
        def told(*of):
            there, spent = evaluated(*of)
            if len(refused) < times:
                refused.append(there.minimum.unknowns)
                way = there.minimum.unknowns - start.minimum.unknowns
                seen = there.minimum.evaluation
                seen = replace(seen, value=seen.value + 1e6, score=seen.score + 1e12 * way)
                return replace(there, minimum=replace(there.minimum, evaluation=seen)), spent
            return there, spent

        return told

    one = replace(CHEAP, iterations=1, learn=False)
    whole = minimised(start, bounds, one, progress=twins.silent, title="").minimum.unknowns
    monkeypatch.setattr(trust_region, "_evaluated", uphill(1))
    part = minimised(start, bounds, one, progress=twins.silent, title="").minimum.unknowns
    lengths = [np.abs(x - start.minimum.unknowns)[:2].max() for x in (whole, part)]
    assert 0.0 < lengths[1] < 0.6 * lengths[0]
    refused.clear()
    monkeypatch.setattr(trust_region, "_evaluated", uphill(99))
    stuck = minimised(start, bounds, one, progress=twins.silent, title="")
    assert stuck.minimum.outcome is Outcome.STUCK
    assert np.array_equal(stuck.minimum.unknowns, start.minimum.unknowns)
    assert len(refused) == TRIALS


def unfollowed(basis, times):
    """A reduced basis that cannot say what it misses, and that cannot be made exact so many times."""
    failures = list[int]()

    class Unfollowed(ReducedBasis):
        def error(self, _at):
            return ModelError(np.inf, np.zeros(0))

        @classmethod
        def update_all(cls, bases, points):
            if len(failures) < times:
                failures.append(1)
                raise NotConverged("folded")
            return super().update_all(bases, points)

    return Unfollowed(*(getattr(basis, field.name) for field in fields(basis)))


@pytest.fixture(scope="module")
def reduced(twins, twin, voxels):
    """Where a loop begins, on a reduced basis."""
    return begun(twins.objective_of(voxels, twin.coefficients), np.append([0.0, 0.0], twin.coefficients))


def test_a_trial_without_equilibrium_is_refused_and_its_reason_told_where_there_is_no_other(twins, reduced):
    bounds, one = twins.settings(1.0).bounds, StopRule(iterations=1)
    (basis,) = reduced.objective.approximations

    def end(times):
        start = replace(reduced, objective=reduced.objective.under([unfollowed(basis, times)]))
        return minimised(start, bounds, one, progress=twins.silent, title="")

    assert end(times=2).totals
    with pytest.raises(NotConverged, match="folded"):
        end(times=TRIALS)


def test_the_history_is_that_of_the_loop_alone_and_begins_where_the_first_start_ended(found):
    (start,) = found.starts
    history = found.minimum.history
    assert len(history) > 1
    assert not set(map(id, history)) & set(map(id, start.minimum.history))


@pytest.mark.parametrize("name", ["step", "linearisation", "model_error"])
def test_what_is_not_met_is_not_called_converged(name):
    met = Convergence(0.9, 0.9, 0.9)
    assert met.converged
    assert met.unmet == ()
    (criterion,) = replace(met, **{name: 1.0}).unmet
    assert criterion is Criterion[name.upper()]
    assert Convergence().unmet == tuple(Criterion)


def test_too_few_iterations_are_not_called_convergence(twins, voxels):
    rule = StopRule(iterations=1)
    found = invert(voxels, twins.settings(0.5), progress=twins.silent, rule=rule)
    assert found.minimum.outcome is Outcome.STEPS
    assert not found.convergence.converged


def test_a_model_that_cannot_be_made_exact_enough_is_not_called_convergence(twins, found):
    end = on(found, found.objective, twins, StopRule(model_error=1e-14, derivatives=False, iterations=3))
    assert end.convergence.unmet == (Criterion.MODEL_ERROR,)
    assert end.minimum.outcome is Outcome.STEPS


def test_an_estimate_may_move_by_a_share_of_its_own_uncertainty_but_not_without_end(found):
    sd = posterior_sd(found.minimum, 2)
    assert StopRule(step_sd=0.1, floor=0.0).tolerance(found.minimum, 2) == pytest.approx(0.1 * sd)
    assert StopRule(step_sd=0.0, floor=0.01).tolerance(found.minimum, 2).tolist() == [0.01, 0.01]


def test_what_an_approximation_misses_is_told_by_how_far_it_sets_the_moduli_off(twins, twin, voxels):
    """H^-1 J^T W (r - r_approximate) with the full model's residuals r, from one right-hand side, to a tenth.

    And by how much larger the objective is on the full model.
    """
    crude = reduced_basis(twin.model, np.exp([0.3, -0.2, 0.0]) * twin.moduli)
    start = begun(twins.objective_of(voxels, twin.coefficients).under([crude]), twin.unknowns)
    objective, here = start.objective, start.minimum
    off, rise = trust_region.set_off(objective, here, trust_region.model_errors(objective, here.unknowns))
    place = LinearisationPoint(objective.parameters.moduli(here.unknowns), here.unknowns[2:])
    full = objective.under([exact_approximation(twin.model, None, place)])(here.unknowns)
    pull = np.zeros(len(here.unknowns))
    for line, exact in zip(here.evaluation.linearisations, full.linearisations, strict=True):
        change = exact.residuals.values - line.residuals.values
        pull[line.columns] += line.jacobian.transposed_times(line.precision * line.weights * change)
    true = np.abs(here.evaluation.covariance_columns(2).T @ pull)
    assert true.max() > 1e-3
    assert off == pytest.approx(true, abs=0.1 * true.max())
    assert rise == pytest.approx(full.value - here.evaluation.value, rel=0.1)


@pytest.mark.parametrize(("share", "exact"), [(0.9, False), (1.1, True), (-1.1, True)])
def test_a_model_is_made_exact_where_it_sets_the_objective_off_by_its_noise_and_a_quarter_of_a_promise(
    twins, reduced, monkeypatch, share, exact
):
    """Though it sets no modulus off: a step would be judged on a J that is not that of the full model."""
    bounds, rule, promised = twins.settings(1.0).bounds, StopRule(iterations=1, derivatives=False, learn=False), []
    reductions = trust_region._Step.reductions

    def told(step, *of):
        promised.append(reductions(step, *of)[1])
        return reductions(step, *of)

    def evaluations(rise):
        monkeypatch.setattr(trust_region, "set_off", lambda *_: (np.zeros(2), rise))
        return minimised(reduced, bounds, rule, progress=twins.silent, title="").minimum.evaluations

    monkeypatch.setattr(trust_region._Step, "reductions", told)
    without = evaluations(0.0)
    assert promised[0] > 0.0
    assert evaluations(share * (0.5 + 0.25 * promised[0])) - without == int(exact)


def test_all_unknowns_are_damped_where_shortening_log_moduli_does_not_help(twins, twin, voxels, monkeypatch):
    """What is lost by a step does not change though its moduli are halved: they are not what was too long."""
    objective, bounds = twins.objective_of(voxels, twin.coefficients), twins.settings(1.0).bounds
    start, seen = begun(objective, np.append([0.0, 0.0], twin.coefficients)), []
    linear_minimum = trust_region._linear_minimum

    def told(now, bounds, rule, region):
        seen.append(region)
        return linear_minimum(now, bounds, rule, region)

    monkeypatch.setattr(trust_region, "_linear_minimum", told)
    monkeypatch.setattr(trust_region._Step, "reductions", lambda *_: (-100.0, 1.0))
    minimised(start, bounds, replace(CHEAP, iterations=1, learn=False), progress=twins.silent, title="")
    first, halved, damped = seen[:3]
    assert (first.damping, halved.damping) == (0.0, 0.0)
    assert halved.radius < first.radius
    assert (damped.radius, damped.damping > 0.0) == (halved.radius, True)


def test_an_approximation_that_cannot_say_what_it_misses_leaves_everything_open(reduced):
    (basis,) = reduced.objective.approximations
    objective = reduced.objective.under([unfollowed(basis, 0)])
    errors = trust_region.model_errors(objective, reduced.minimum.unknowns)
    off, rise = trust_region.set_off(objective, reduced.minimum, errors)
    assert rise == np.inf
    assert off.tolist() == [np.inf, np.inf]


def test_derivatives_that_are_exact_nowhere_leave_everything_open(found):
    state, minimum = found.objective.states[0], found.minimum
    basis = state.approximation
    here = LinearisationPoint(
        found.objective.parameters.moduli(minimum.unknowns), minimum.unknowns[2:], np.eye(3, 1), np.eye(3)
    )

    def left(place):
        return trust_region.linearisation_distance(
            found.objective.under([replace(basis, place=place)]), minimum.unknowns
        )

    assert left(None) == np.inf
    assert left(replace(here, directions=None)) == np.inf
    assert left(here) == pytest.approx(0.0, abs=1e-12)
    assert left(replace(here, moduli=here.moduli * np.exp([0.1, -0.05, 0.0]))) == pytest.approx(0.1)


def test_another_start_leaves_the_first_objective_as_it_was(twins, twin, voxels):
    objective = twins.objective_of(voxels, twin.coefficients)
    before = objective.rematched(twin.unknowns)(twin.unknowns).value
    minimised(begun(objective, twin.unknowns), twins.settings(1.0).bounds, CHEAP, progress=twins.silent, title="")
    assert isinstance(objective, Objective)
    assert objective.rematched(twin.unknowns)(twin.unknowns).value == before
