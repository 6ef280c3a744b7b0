"""From models and observations to the moduli that explain the later images: starts, linear law, finite strain."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from palpate.approximation.expansion import Expansion, coarse_equilibrium, expansion_around
from palpate.errors import ConfigurationError, EstimationError, NotConverged
from palpate.inversion.candidates import COMPARED, Inversion, StartRun, as_good, concluded, grouped, members
from palpate.inversion.frozen_posterior import cheapest
from palpate.inversion.hyper_parameters import with_first_noise
from palpate.inversion.informed_subspace import informed_problem
from palpate.inversion.later_state import InverseProblem, LaterState
from palpate.inversion.objective import AS_GOOD, Objective
from palpate.inversion.optimise import (
    Bounds,
    Minimum,
    Outcome,
    gauss_newton,
    same_minimum,
)
from palpate.inversion.trust_region import (
    NEAR,
    OuterIterate,
    StopRule,
    begun,
    fit_coefficients,
    minimised,
    total_counted_as,
    with_fewest,
)
from palpate.mechanics.equilibrium import ACCURACY
from palpate.mechanics.finite_strain import FiniteStrainEquilibrium
from palpate.parallel import blas_on_one_thread
from palpate.progress import Progress, during

REPORTED = StopRule()
FOLLOWED = 2  # minima of starts beside the first one, the best
EQUILIBRIUM = 1e-5  # of the forces, while the estimate moves


@dataclass(frozen=True, slots=True)
class InversionSettings:
    """Starts theta (n_parameters,) each, and their bounds; the first minimum is sought from the middle of `starts`."""

    starts: tuple[NDArray[np.float64], ...]
    bounds: Bounds
    further: tuple[NDArray[np.float64], ...] = ()

    @property
    def every_start(self) -> tuple[NDArray[np.float64], ...]:
        """All starts (n_parameters,), the further ones last."""
        return self.starts + self.further

    def middle(self, problem: InverseProblem) -> NDArray[np.float64]:
        """Unknowns (n_unknowns,) of a problem at the middle of the `starts`, where nothing else acts."""
        theta = np.median(np.stack(self.starts), axis=0)
        return np.concatenate([theta, np.zeros(problem.parameters.n_coefficients)])

    def centre(self, problem: InverseProblem) -> NDArray[np.float64]:
        """Unknowns (n_unknowns,) at the middle of the bounds, or at the end of the starts' range nearest to it."""
        starts, theta = np.stack(self.starts), 0.5 * (self.bounds.lower + self.bounds.upper)
        theta = np.clip(theta, starts.min(axis=0), starts.max(axis=0))
        return np.concatenate([theta, np.zeros(problem.parameters.n_coefficients)])


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
    last = None if problem.finite_strain else rule
    if any(state.approximation is None for state in problem.states):
        linear = [_linear(*_with_reduced_bases(problem, settings, progress), settings, last, progress)]
    else:
        objective = _at_rest(Objective(problem.states, problem.parameters))
        linear = [_linear(objective, settings.middle(problem), 0, settings, last, progress)]
    if not problem.finite_strain:
        return with_released(linear[0], settings, progress=progress, rule=rule)
    there = during("finite strain", progress)
    found = continue_at_finite_strain(linear.pop(), settings, progress=there, rule=rule)  # which lets go of its bases
    return with_released(found, settings, progress=there, rule=rule)


@blas_on_one_thread()
def first_noise_of(
    problem: InverseProblem, settings: InversionSettings, *, progress: Progress
) -> tuple[Objective, Minimum]:
    """What an estimate begins with under the linear law: the objective under the noise that the images show, and where.

    Its minimum is near the middle start, and no estimate: no other start and no exact derivative was tried. Raises as
    `invert` does.
    """
    objective, unknowns, _ = _with_reduced_bases(problem.linear(), settings, progress)
    nearby = minimised(begun(objective, unknowns), settings.bounds, NEAR, progress=progress, title="the middle start")
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
        objective, evaluation = before.objective.released(before.minimum.evaluation, unknowns)
        points = objective.linearisation_points(unknowns, evaluation)
        near = [known.update(point) for known, point in zip(objective.approximations, points, strict=True)]
        objective = objective.under(near)
        start = begun(objective, _on_cheapest(objective, unknowns, bounds), history=before.minimum.history)
        start = replace(start, checks=before.checks)
        end = free = minimised(start, bounds, NEAR, progress=progress, title=title)
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


def _with_reduced_bases(
    problem: InverseProblem, settings: InversionSettings, progress: Progress
) -> tuple[Objective, NDArray[np.float64], int]:
    """The objective on reduced bases, unknowns (n_unknowns,) at the middle start, the motion fitted, what it cost.

    Its blocks hold what the images tell of those of the problem, asked where no start decides (see `centre`): of two
    sets of starts each would else have a problem of its own.
    """
    informed = informed_problem(problem, settings.centre(problem), progress=progress)
    parameters, unknowns = informed.problem.parameters, informed.unknowns
    progress(f"how the responses to {parameters.n_coefficients} unknowns that are seen change with the moduli")
    by_theta, coefficients = parameters.derivatives(unknowns), parameters.coefficients(unknowns)
    triples = zip(informed.problem.states, informed.bases, coefficients, strict=True)
    states = tuple(state.with_approximation(basis.with_modulus_series(q, by_theta)) for state, basis, q in triples)
    objective, theta = _at_rest(Objective(states, parameters)), settings.middle(problem)[: parameters.n_parameters]
    if np.allclose(theta, unknowns[: len(theta)]):
        return objective, unknowns, informed.evaluations
    fitted = fit_coefficients(objective, np.concatenate([theta, unknowns[len(theta) :]]))
    return objective, fitted.unknowns, informed.evaluations + fitted.evaluations


def _at_rest(objective: Objective) -> Objective:
    """The objective before any residual is seen, with what belongs together where nothing has moved."""
    return with_first_noise(objective).rematched(np.zeros(objective.parameters.n_unknowns))


def _linear(
    objective: Objective,
    begin: NDArray[np.float64],
    evaluations: int,
    settings: InversionSettings,
    rule: StopRule | None,
    progress: Progress,
) -> Inversion:
    """The estimate of the linear law: every start on the cheap model, the best ones followed to their ends.

    objective: as it is at rest; rule: of the starts that are followed, None: they end near, as the start of another
    law. begin (n_unknowns,): the middle start, with the blocks' coefficients near the best ones there, and what it cost
    to find them in evaluations.
    """
    n, bounds, rest = objective.n_parameters, settings.bounds, objective(np.zeros(objective.parameters.n_unknowns))
    first = minimised(begun(objective, begin), bounds, NEAR, progress=progress, title="the middle start")
    screened = _screened(first, settings, progress)
    groups = grouped(screened, n)
    ends = [first]
    belongs = {groups[i]: 0 for i, m in enumerate(screened) if same_minimum(m.unknowns, first.minimum, n)}
    others = [min(members(groups, g), key=lambda i: screened[i].evaluation.value) for g in dict.fromkeys(groups)]
    others = sorted((i for i in others if groups[i] not in belongs), key=lambda i: screened[i].evaluation.value)
    for number in [i for i in others if screened[i].converged][:FOLLOWED]:
        start, belongs[groups[number]] = begun(first.objective, screened[number].unknowns), len(ends)
        ends.append(minimised(start, bounds, COMPARED, progress=progress, title=f"start {number + 1}"))
    same = grouped([end.minimum for end in ends], n)
    fewest = with_fewest(ends)
    totals = [total_counted_as(end, fewest) if end.minimum.converged else np.inf for end in ends]
    best = [min(members(same, g), key=lambda i: totals[i]) for g in range(max(same) + 1)]
    order = sorted(best, key=lambda i: totals[i])
    for number in order:
        if rule is not None and (number == order[0] or as_good(totals[number], totals[order[0]])):
            ends[number] = minimised(ends[number], bounds, rule, progress=progress, title="linear law")
    followed = [ends[number] for number in order]
    rank = {number: order.index(best[same[number]]) for number in range(len(ends))}
    starts = tuple(
        StartRun(theta, minimum, rank[belongs[group]] if group in belongs else None)
        for theta, minimum, group in zip(settings.every_start, screened, groups, strict=True)
    )
    found = concluded(followed, starts, rest, bounds, 0)
    of_first = followed[0].counts
    counts = sum((other.counts - of_first for other in followed[1:]), of_first)
    evaluations += 1 + sum(end.minimum.evaluations for end in ends) + found.evaluations
    return replace(found, evaluations=evaluations, counts=counts)


def _screened(first: OuterIterate, settings: InversionSettings, progress: Progress) -> list[Minimum]:
    """A minimum from every start on the cheapest model: closest points and hyper-parameters as at a first minimum.

    Where that is no reduced model, on one that only has the former.
    """
    at, n = first.minimum, first.objective.n_parameters
    progress(f"{len(settings.every_start)} starts, with the closest points of the first minimum")
    cheap, found = cheapest(first.objective, at.unknowns, at.evaluation), list[Minimum]()
    for theta in settings.every_start:
        begin = np.concatenate([theta, at.unknowns[n:]])
        found.append(gauss_newton(cheap, begin, bounds=settings.bounds, tolerance=AS_GOOD / 200.0))
    return found


def _on_cheapest(objective: Objective, unknowns: NDArray[np.float64], bounds: Bounds) -> NDArray[np.float64]:
    """Unknowns (n_unknowns,) of the minimum on the cheapest model, or on the way there as far as models are trusted."""
    cheap = cheapest(objective, unknowns, objective(unknowns))
    found = gauss_newton(cheap, unknowns, bounds=bounds, tolerance=AS_GOOD / 200.0)
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
