"""From an estimate to its end under a finite-strain law, and with those blocks free that were fixed."""

from __future__ import annotations

from dataclasses import replace

from palpate.approximation.expansion import coarse_equilibrium, expansion_around
from palpate.errors import EstimationError, NotConverged
from palpate.inversion.candidates import Inversion, concluded
from palpate.inversion.frozen_posterior import predicted_minimum
from palpate.inversion.later_state import LaterState
from palpate.inversion.objective import AS_GOOD, Objective
from palpate.inversion.optimise import Bounds, Outcome
from palpate.inversion.trust_region import (
    NEAR,
    REPORTED,
    OuterIterate,
    StopRule,
    begun,
    minimised,
    total_counted_as,
)
from palpate.mechanics.finite_strain import FiniteStrainEquilibrium
from palpate.progress import Progress

RELEASED = replace(NEAR, all_material=False)  # whether images tell of what was fixed hangs on what decides alone
EQUILIBRIUM = 1e-5  # of the forces, while the estimate moves


def continue_at_finite_strain(
    linear: Inversion, bounds: Bounds, *, progress: Progress, rule: StopRule = REPORTED
) -> Inversion:
    """The estimate under the law of the states' `finite_strain` models, from the candidates of the `linear` one.

    The best one is continued always, the others where they are minima; of these one without equilibrium, or that
    cannot be followed for another reason, is left out of the comparison. rule: when each ends. Raises `NotConverged`
    when the best one's equilibrium is not found, with the element and the share of the motion where it ended.
    """
    ends, spent, evaluations = dict[int, OuterIterate](), linear.counts, linear.evaluations
    for number, candidate in sorted(enumerate(linear.candidates), key=lambda pair: pair[0] != linear.best):
        minimum = candidate.minimum
        if number != linear.best and not minimum.converged:
            ends[number] = candidate.iterate
            continue
        try:
            progress("finite strain: the equilibrium at the linear estimate")
            objective, coarse = _coarse(candidate.iterate)
            first = [expansion_around(each, tolerance=EQUILIBRIUM, progress=progress) for each in coarse]
            start = [begun(objective.under(first), minimum.unknowns, history=minimum.history)]
            del coarse, first  # no longer needed where the loop goes on, and large
            end = minimised(start.pop(), bounds, rule, progress=progress, title="finite strain")
            progress("finite strain: the exact equilibrium at the estimate")
            ends[number] = end = end.at_equilibrium()
            spent, evaluations = spent + end.counts, evaluations + end.minimum.evaluations
        except EstimationError as error:
            if number == linear.best:
                raise
            progress(f"finite strain: another minimum is left out: {error}")
            outcome = Outcome.NO_EQUILIBRIUM if isinstance(error, NotConverged) else Outcome.NOT_FOLLOWED
            ends[number] = replace(ends[linear.best], minimum=replace(minimum, outcome=outcome))
    ended = [ends[number] for number in sorted(ends)]
    found = concluded(ended, linear.starts, linear.rest, bounds, linear.best)
    return replace(found, evaluations=found.evaluations + evaluations, counts=spent)


def with_released(inversion: Inversion, bounds: Bounds, *, progress: Progress, rule: StopRule) -> Inversion:
    """The inversion with its best minimum followed on with those blocks free that were fixed (see `Block.released`).

    Where J, with their prior odds and the same numbers of independent residuals, is then less by more than what is as
    good, the images tell of what was fixed, and this is the estimate, followed until it ends by the `rule`. Where it
    does not end the inversion says why. Nothing changes where there is no such block, or no minimum to follow.
    """
    best = inversion.candidates[inversion.best]
    before, released = best.iterate, [block for block in inversion.objective.parameters.blocks if block.released]
    if not before.minimum.converged or not released:
        return inversion
    title = f"with {' and '.join(dict.fromkeys(block.cause for block in released))} free"
    free, end, gain, unsettled = None, before, 0.0, ""
    try:
        objective = replace(before.objective, parameters=before.objective.parameters.released())
        begin = predicted_minimum(objective, before.minimum.unknowns, bounds)
        start = replace(begun(objective, begin, history=before.minimum.history), checks=before.checks)
        end = free = minimised(start, bounds, RELEASED, progress=progress, title=title)
        gain = before.objective.total(before.minimum.evaluation) - total_counted_as(free, before)
        gain += min(block.released_odds for block in released)
        if free.minimum.converged and gain > AS_GOOD:
            end = minimised(free, bounds, rule, progress=progress, title=title)
            end = end.at_equilibrium() if inversion.objective.states[0].finite_strain else end
        unsettled = "" if end.minimum.converged else end.minimum.outcome.value
    except EstimationError as error:
        unsettled = str(error)
    if free is None:
        return replace(inversion, unsettled=unsettled)
    evaluations, counts = inversion.evaluations + end.minimum.evaluations, inversion.counts + end.counts - before.counts
    found = replace(inversion, evaluations=evaluations, counts=counts, released=free, unsettled=unsettled)
    if unsettled or end is free:
        return found
    candidates = list(inversion.candidates)
    candidates[inversion.best] = replace(best, iterate=end, value=best.value - gain)
    return replace(found, candidates=tuple(candidates), released=None)


def _coarse(linear: OuterIterate) -> tuple[Objective, list[FiniteStrainEquilibrium]]:
    """The objective of a linear minimum on no approximation, and the coarse equilibria there of every state.

    Its states bend as the linear law does.
    """
    before, points = linear.objective, linear.objective.linearisation_points(linear.minimum.unknowns)
    found, states = list[FiniteStrainEquilibrium](), list[LaterState]()
    for state, basis, point in zip(before.states, before.approximations, points, strict=True):
        assert state.finite_strain is not None
        found.append(coarse_equilibrium(state.finite_strain, basis, point))
        states.append(replace(state, approximation=None, bending=basis))
    return replace(before, states=tuple(states)), found
