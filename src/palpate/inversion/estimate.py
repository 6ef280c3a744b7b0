"""From models and observations to the moduli that explain the later images: starts, linear law, finite strain."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from palpate.approximation.expansion import Expansion, coarse_equilibrium, expansion_around
from palpate.errors import ConfigurationError, EstimationError, NotConverged
from palpate.inversion.candidates import Inversion, InversionSettings, concluded, from_starts
from palpate.inversion.frozen_posterior import cheapest_minima
from palpate.inversion.informed_subspace import at_rest, informed_objective
from palpate.inversion.later_state import InverseProblem, LaterState
from palpate.inversion.objective import AS_GOOD, Objective
from palpate.inversion.optimise import (
    Bounds,
    Minimum,
    Outcome,
)
from palpate.inversion.trust_region import (
    NEAR,
    OuterIterate,
    StopRule,
    begun,
    minimised,
    total_counted_as,
)
from palpate.mechanics.equilibrium import ACCURACY
from palpate.mechanics.finite_strain import FiniteStrainEquilibrium
from palpate.parallel import blas_on_one_thread
from palpate.progress import Progress, during

REPORTED = StopRule()
RELEASED = replace(NEAR, all_material=False)  # whether images tell of what was fixed hangs on what decides alone
EQUILIBRIUM = 1e-5  # of the forces, while the estimate moves


@blas_on_one_thread()
def invert(
    problem: InverseProblem, settings: InversionSettings, *, progress: Progress, rule: StopRule = REPORTED
) -> Inversion:
    """Estimate log-moduli and drivers' motion together, from all starts, with the linear law first.

    States that bring an approximation are estimated on it; for the others a reduced basis is made at the middle of the
    bounds and extended where the estimate goes. rule: when the estimate ends; a linear one that another law follows
    ends near. At last blocks that were fixed are released, see `with_released`.
    Raises `ConfigurationError` for an unknown Poisson's ratio with another law, `EstimationError`s of solving; an
    estimate that did not converge says so in its minimum's outcome.
    """
    if problem.finite_strain and problem.parameters.poisson:
        raise ConfigurationError(
            "a Poisson's ratio can be sought under the linear law only: the finite-strain models hold those of the"
            " tissues; seek none, or leave out the states' `finite_strain` models (`InverseProblem.linear`)"
        )
    if not problem.finite_strain:
        found = _linear(problem, settings, rule, progress)
        return with_released(found, settings, progress=progress, rule=rule)
    there = during("finite strain", progress)
    # nothing else holds the linear minima, so that it lets go of their bases
    found = continue_at_finite_strain(_linear(problem, settings, None, progress), settings, progress=there, rule=rule)
    return with_released(found, settings, progress=there, rule=rule)


@blas_on_one_thread()
def first_noise_of(
    problem: InverseProblem, settings: InversionSettings, *, progress: Progress
) -> tuple[Objective, Minimum]:
    """What an estimate begins with under the linear law: the objective under the noise that the images show, and where.

    Its minimum is the first one, and no estimate: no start was tried. Raises as `invert` does.
    """
    objective, unknowns, _ = informed_objective(problem.linear(), settings.centre(problem), progress=progress)
    nearby = minimised(begun(objective, unknowns), settings.bounds, NEAR, progress=progress, title="the first minimum")
    return nearby.objective, nearby.minimum


def continue_at_finite_strain(
    linear: Inversion, settings: InversionSettings, *, progress: Progress, rule: StopRule = REPORTED
) -> Inversion:
    """The estimate under the law of the states' `finite_strain` models, from the candidates of the `linear` one.

    The best one is continued always, the others where they are minima; of these one without equilibrium, or that
    cannot be followed for another reason, is left out of the comparison. rule: when each ends. Raises `NotConverged`
    when the best one's equilibrium is not found, with the element and the share of the motion where it ended.
    """
    waiting = {number: candidate.iterate for number, candidate in enumerate(linear.candidates)}
    linear = replace(linear, candidates=())  # and with them their reduced bases, which are large, one by one
    ends, spent, evaluations = dict[int, OuterIterate](), linear.counts, linear.evaluations
    for number in sorted(waiting, key=lambda k: k != linear.best):
        minimum = waiting[number].minimum
        if number != linear.best and not minimum.converged:
            ends[number] = waiting.pop(number)
            continue
        try:
            progress("finite strain: the equilibrium at the linear estimate")
            start = [_expanded(*_coarse(waiting.pop(number)), minimum, progress)]
            end = minimised(start.pop(), settings.bounds, rule, progress=progress, title="finite strain")
            progress("finite strain: the exact equilibrium at the estimate")
            ends[number] = end = _at_equilibrium(end)
            spent, evaluations = spent + end.counts, evaluations + end.minimum.evaluations
        except EstimationError as error:
            if number == linear.best:
                raise
            progress(f"finite strain: another minimum is left out: {error}")
            outcome = Outcome.NO_EQUILIBRIUM if isinstance(error, NotConverged) else Outcome.NOT_FOLLOWED
            ends[number] = replace(ends[linear.best], minimum=replace(minimum, outcome=outcome))
    ended = [ends[number] for number in sorted(ends)]
    found = concluded(ended, linear.starts, linear.rest, settings.bounds, linear.best)
    return replace(found, evaluations=found.evaluations + evaluations, counts=spent)


def with_released(
    inversion: Inversion, settings: InversionSettings, *, progress: Progress, rule: StopRule
) -> Inversion:
    """The inversion with its best minimum followed on with those blocks free that were fixed (see `Block.released`).

    Where J, with their prior odds and the same numbers of independent residuals, is then less by more than what is as
    good, the images tell of what was fixed, and this is the estimate, followed until it ends by the `rule`. Where it
    does not end the inversion says why. Nothing changes where there is no such block, or no minimum to follow.
    """
    best = inversion.candidates[inversion.best]
    before, released = best.iterate, [block for block in inversion.objective.parameters.blocks if block.released]
    if not before.minimum.converged or not released:
        return inversion
    unknowns, bounds = before.minimum.unknowns, settings.bounds
    followed, title = inversion, f"with {' and '.join(dict.fromkeys(block.cause for block in released))} free"
    try:
        objective = replace(before.objective, parameters=before.objective.parameters.released())
        start = begun(objective, _on_cheapest(objective, unknowns, bounds), history=before.minimum.history)
        start = replace(start, checks=before.checks)
        end = free = minimised(start, bounds, RELEASED, progress=progress, title=title)
        followed = _followed(inversion, before, free, free)
        gain = before.objective.total(before.minimum.evaluation) - total_counted_as(free, before)
        gain += min(block.released_odds for block in released)
        if free.minimum.converged and gain > AS_GOOD:
            end = minimised(free, bounds, rule, progress=progress, title=title)
            end = _at_equilibrium(end) if inversion.objective.states[0].finite_strain else end
            followed = _followed(inversion, before, free, end)
    except EstimationError as error:
        return replace(followed, unsettled=str(error))
    if not end.minimum.converged:
        return replace(followed, unsettled=end.minimum.outcome.value)
    if end is free:
        return followed
    candidates = list(inversion.candidates)
    candidates[inversion.best] = replace(best, iterate=end, value=best.value - gain)
    return replace(followed, candidates=tuple(candidates), released=None)


def _followed(inversion: Inversion, before: OuterIterate, free: OuterIterate, end: OuterIterate) -> Inversion:
    """The inversion with its best minimum `free`, and with what it cost to follow this from `before` to `end`."""
    spent, evaluations = end.counts - before.counts, inversion.evaluations + end.minimum.evaluations
    return replace(inversion, evaluations=evaluations, counts=inversion.counts + spent, released=free)


def _linear(
    problem: InverseProblem, settings: InversionSettings, rule: StopRule | None, progress: Progress
) -> Inversion:
    """The estimate of the linear law from all starts, on the states' own approximations or on reduced bases."""
    begin, spent = settings.centre(problem), 0
    if any(state.approximation is None for state in problem.states):
        objective, begin, spent = informed_objective(problem, begin, progress=progress)
    else:
        objective = at_rest(Objective(problem.states, problem.parameters))
    found = from_starts(objective, begin, settings, rule=rule, progress=progress)
    return replace(found, evaluations=found.evaluations + spent)


def _on_cheapest(objective: Objective, unknowns: NDArray[np.float64], bounds: Bounds) -> NDArray[np.float64]:
    """Unknowns (n_unknowns,) of the minimum on the cheapest model, or on the way there as far as models are trusted."""
    (found,) = cheapest_minima(objective, unknowns, objective(unknowns), [unknowns], bounds)
    away = found.unknowns - unknowns if found.converged else np.zeros(len(unknowns))
    moduli = np.append(np.arange(objective.n_parameters), objective.parameters.acting_on_moduli)
    furthest = float(np.max(np.abs(away[moduli]), initial=0.0))
    trusted = min(approximation.trust_radius for approximation in objective.approximations)
    return np.asarray(unknowns + min(1.0, trusted / max(furthest, 1e-9)) * away)


def _coarse(linear: OuterIterate) -> tuple[Objective, list[FiniteStrainEquilibrium]]:
    """The objective of a linear minimum on no approximation, and the coarse equilibria there of every state.

    Its states bend as the linear law does.
    """
    before, points = linear.objective, linear.objective.linearisation_points(linear.minimum.unknowns)
    found, states = list[FiniteStrainEquilibrium](), list[LaterState]()
    for state, basis, point in zip(before.states, before.approximations, points, strict=True):
        assert state.finite_strain is not None
        found.append(coarse_equilibrium(state.finite_strain, basis, point))
        states.append(replace(state, approximation=None, bending=state.observed))
    return replace(before, states=tuple(states)), found


def _expanded(
    objective: Objective, coarse: Sequence[FiniteStrainEquilibrium], minimum: Minimum, progress: Progress
) -> OuterIterate:
    """A linear minimum on expansions around the equilibria there."""
    first = [expansion_around(equilibrium, tolerance=EQUILIBRIUM, progress=progress) for equilibrium in coarse]
    return begun(objective.under(first), minimum.unknowns, history=minimum.history)


def _at_equilibrium(end: OuterIterate) -> OuterIterate:
    """The end of an outer loop at exact equilibria."""
    exact = []
    points = end.objective.linearisation_points(end.minimum.unknowns)
    for approximation, point in zip(end.objective.approximations, points, strict=True):
        assert isinstance(approximation, Expansion)
        exact.append(approximation.at_equilibrium(point, tolerance=ACCURACY))
    final = end.objective.under(exact)
    evaluation, spent = final(end.minimum.unknowns), end.minimum.evaluations + 1
    minimum = replace(end.minimum, evaluation=evaluation, evaluations=spent)
    return replace(end, objective=final, minimum=minimum)
