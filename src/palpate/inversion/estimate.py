"""From models and observations to the moduli that explain the later images: starts, linear law, finite strain."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from palpate.errors import ConfigurationError, EstimationError, NotConverged
from palpate.inversion.evidence import with_learned_prior
from palpate.inversion.expansion import Expansion, coarse_equilibrium, expansion_around
from palpate.inversion.informed_subspace import informed_problem
from palpate.inversion.later_state import InverseProblem, LaterState
from palpate.inversion.objective import Evaluation, Objective
from palpate.inversion.optimise import (
    TO_THE_NOISE,
    Iterate,
    Minimum,
    Outcome,
    fit_coefficients,
    gauss_newton,
    same_minimum,
)
from palpate.inversion.outer_loop import (
    Convergence,
    InversionSettings,
    OuterIterate,
    StopRule,
    minimised,
    run_outer_loop,
    updated,
)
from palpate.inversion.reweighting import with_first_noise, with_found_noise
from palpate.mechanics.equilibrium import ACCURACY
from palpate.mechanics.finite_strain import FiniteStrainEquilibrium
from palpate.mechanics.forward import SolveCounts
from palpate.parallel import blas_on_one_thread
from palpate.progress import Progress, during

OTHER = 1e-2  # decrement of minima that are compared: a two-hundredth of what tells them apart
AS_GOOD = 1.92  # of minus the log-posterior: half the 95 % quantile of chi-squared with one degree of freedom
REPORTED = StopRule()
FIRST_GUESS = StopRule(
    step_sd=0.5, model_error=np.inf, derivatives=False, solve_above=0.1, passes=1, iterations=1, far=np.inf
)
RELEASED = StopRule(step_sd=0.2, passes=2, iterations=5)  # an interval, to a tenth of its half-width
EQUILIBRIUM = 1e-5  # of the forces, while the estimate moves


@dataclass(frozen=True, slots=True)
class StartRun:
    """What one start did on its own: log-moduli (n_parameters,) where it began, the minimum it found and the way there.

    candidate: number of the distinct minimum that it leads to.
    """

    theta: NDArray[np.float64]
    minimum: Minimum
    candidate: int


@dataclass(frozen=True, slots=True)
class Candidate:
    """A distinct minimum as it ended, and its value under the one objective under which all candidates are compared."""

    iterate: OuterIterate
    value: float

    @property
    def minimum(self) -> Minimum:
        """The minimum under its own objective."""
        return self.iterate.minimum


@dataclass(frozen=True, slots=True)
class Inversion:
    """The distinct minima, the number of the best one, every start, and the evaluation at no motion (`rest`).

    evaluations, counts: of everything that was followed to find and compare them, not of the best one alone.
    """

    candidates: tuple[Candidate, ...]
    best: int
    starts: tuple[StartRun, ...]
    rest: Evaluation
    evaluations: int
    counts: SolveCounts

    @property
    def objective(self) -> Objective:
        """The objective of the best minimum, with its approximations and noise models."""
        return self.candidates[self.best].iterate.objective

    @property
    def minimum(self) -> Minimum:
        """The best minimum; its history is that of the outer loop that all of its starts share."""
        return self.candidates[self.best].minimum

    @property
    def convergence(self) -> Convergence:
        """What the best minimum's last outer iteration left open."""
        return self.candidates[self.best].iterate.convergence


def as_good(value: float, best: float, *, scale: float = 1.0) -> bool:
    """Whether a minimum with a `value` of minus the log-posterior cannot be told from one with the value `best`.

    By the rule of a 95 % interval: twice their difference, times a `scale` of the deviance (see `Profile`), is below
    1.96^2. What a value is worth does not depend on how many residuals make it up.
    """
    return scale * (value - best) < AS_GOOD


@blas_on_one_thread()
def invert(
    problem: InverseProblem, settings: InversionSettings, *, progress: Progress, rule: StopRule = REPORTED
) -> Inversion:
    """Estimate log-moduli and drivers' motion together, from all starts, with the linear law first.

    States that bring an approximation are estimated on it; for the others a reduced basis is made at the middle start
    and extended where the estimate goes. rule: when the estimate ends; a linear one that another law follows ends near.
    Raises `ConfigurationError` for an open Poisson's ratio with another law, `EstimationError`s of solving; an estimate
    that did not converge says so in its minimum's outcome.
    """
    if problem.finite_strain and problem.parameters.poisson:
        raise ConfigurationError(
            "a Poisson's ratio can be sought under the linear law only: the finite-strain models hold those of the"
            " tissues; seek none, or leave out the states' `finite_strain` models (`InverseProblem.linear`)"
        )
    middle = np.asarray(np.median(np.stack(settings.starts), axis=0))
    begin = np.concatenate([middle, np.zeros(problem.parameters.n_coefficients)])
    first = FIRST_GUESS if problem.finite_strain else rule
    if any(state.approximation is None for state in problem.states):
        linear = [_linear(*_with_reduced_bases(problem, settings, begin, progress), settings, first, progress)]
    else:
        linear = [_linear(Objective(problem.states, problem.parameters), begin, 0, settings, first, progress)]
    if not problem.finite_strain:
        return linear[0]
    there = during("finite strain", progress)
    return continue_at_finite_strain(linear.pop(), settings, progress=there, rule=rule)  # which lets go of its bases


@blas_on_one_thread()
def first_noise_of(
    problem: InverseProblem, settings: InversionSettings, *, progress: Progress
) -> tuple[Objective, Minimum]:
    """What an estimate begins with under the linear law: the objective under the noise that the images show, and where.

    Its minimum is near the middle start, and no estimate: no start, robust weight or exact derivative was tried. Raises
    as `invert` does.
    """
    middle = np.asarray(np.median(np.stack(settings.starts), axis=0))
    begin = np.concatenate([middle, np.zeros(problem.parameters.n_coefficients)])
    objective, unknowns, _ = _with_reduced_bases(problem.linear(), settings, begin, progress)
    objective, _, _, nearby = _nearby(objective, unknowns, settings, progress)
    return objective, nearby


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
            end = run_outer_loop(start.pop(), settings, rule, progress=progress, title="finite strain")
            progress("finite strain: the exact equilibrium at the estimate")
            ends[number] = end = _at_equilibrium(end, minimum.history)
            spent, evaluations = spent + end.counts, evaluations + end.minimum.evaluations
        except EstimationError as error:
            if number == linear.best:
                raise
            progress(f"finite strain: another minimum is left out: {error}")
            outcome = Outcome.NO_EQUILIBRIUM if isinstance(error, NotConverged) else Outcome.NOT_FOLLOWED
            ends[number] = replace(ends[linear.best], minimum=replace(minimum, outcome=outcome))
    found = _concluded([ends[number] for number in sorted(ends)], linear.starts, linear.rest, settings, linear.best)
    return replace(found, evaluations=found.evaluations + evaluations, counts=spent)


@blas_on_one_thread()
def with_released(
    inversion: Inversion, settings: InversionSettings, *, progress: Progress, rule: StopRule = RELEASED
) -> OuterIterate | None:
    """The best minimum followed on with those blocks free that were held while it was sought (see `Block.released`).

    None where there is no such block, or no minimum to follow. Raises `EstimationError`s of solving; one that did not
    converge says so in its minimum's outcome.
    """
    best = inversion.candidates[inversion.best].iterate
    causes = dict.fromkeys(block.cause for block in inversion.objective.parameters.blocks if block.released)
    if not best.minimum.converged or not causes:
        return None
    objective, evaluation = best.objective.released(best.minimum.evaluation, best.minimum.unknowns)
    start = replace(best, objective=objective, minimum=replace(best.minimum, evaluation=evaluation))
    return run_outer_loop(start, settings, rule, progress=progress, title=f"with {' and '.join(causes)} free")


def _with_reduced_bases(
    problem: InverseProblem, settings: InversionSettings, middle: NDArray[np.float64], progress: Progress
) -> tuple[Objective, NDArray[np.float64], int]:
    """The objective on reduced bases at unknowns (n_unknowns,), these with the drivers' motion fitted, its cost.

    Its blocks hold what the images tell of those of the problem.
    """
    informed = informed_problem(problem, middle, bounds=settings.bounds, progress=progress)
    parameters, unknowns = informed.problem.parameters, informed.unknowns
    progress(f"how the responses to {parameters.n_coefficients} unknowns that are seen change with the moduli")
    by_theta, coefficients = parameters.derivatives(unknowns), parameters.coefficients(unknowns)
    triples = zip(informed.problem.states, informed.bases, coefficients, strict=True)
    states = tuple(state.with_approximation(basis.with_modulus_series(q, by_theta)) for state, basis, q in triples)
    return Objective(states, parameters), unknowns, informed.evaluations


def _linear(
    objective: Objective,
    begin: NDArray[np.float64],
    evaluations: int,
    settings: InversionSettings,
    rule: StopRule,
    progress: Progress,
) -> Inversion:
    """The estimate of the linear law: every start under the first noise model, the best one followed to its end.

    begin (n_unknowns,): the middle start, with drivers' coefficients near the best ones there, and what it cost to find
    them in evaluations.
    """
    objective, rest, fitted, nearby = _nearby(objective, begin, settings, progress)
    n = objective.n_parameters
    fitted, nearby = _remembered(fitted), _remembered(nearby)
    minima = _from_starts(objective, settings, nearby.unknowns[n:], progress)
    first = _best(minima)
    start = [updated(objective, replace(minima[first], evaluations=0), rule)]
    minima = [_remembered(minimum) for minimum in minima]
    del objective  # and with it its approximations, which are large, when others take their place
    followed = [run_outer_loop(start.pop(), settings, rule, progress=progress, title="linear law")]
    found = followed[0].minimum.evaluation  # minima may lie apart under the first noise and be one under what was found
    groups = _groups([replace(minimum, evaluation=found) for minimum in minima], n)
    best = groups[first]
    for group in dict.fromkeys(g for g in groups if g != best):
        member = min((m for m, g in zip(minima, groups, strict=True) if g == group), key=lambda m: m.evaluation.value)
        followed.append(_another(followed[0], member, settings, rule, progress))
    order = [best, *dict.fromkeys(g for g in groups if g != best)]
    triples = zip(settings.starts, minima, groups, strict=True)
    starts = tuple(StartRun(theta, minimum, order.index(group)) for theta, minimum, group in triples)
    evaluations += 1 + sum(m.evaluations for m in (fitted, nearby, *minima, *(f.minimum for f in followed)))
    concluded = _concluded(followed, starts, rest, settings, 0)
    of_first = followed[0].counts  # the others' approximations are this one's, extended
    spent = sum((other.counts - of_first for other in followed[1:]), of_first)
    return replace(concluded, evaluations=concluded.evaluations + evaluations, counts=spent)


def _nearby(
    objective: Objective, begin: NDArray[np.float64], settings: InversionSettings, progress: Progress
) -> tuple[Objective, Evaluation, Minimum, Minimum]:
    """The objective under the noise that images show near unknowns (n_unknowns,), and what it was found by.

    That at no motion, the drivers' motion fitted at `begin`, and the minimum under the first noise.
    """
    still = np.zeros(objective.parameters.n_unknowns)
    objective = with_first_noise(objective).rematched(still)
    rest = objective(still)
    fitted = fit_coefficients(objective, begin, bounds=settings.bounds, tolerance=TO_THE_NOISE)
    objective = with_learned_prior(objective, fitted.evaluation, fitted.unknowns)
    progress("the noise of the images, near the middle start")
    nearby = gauss_newton(
        objective.rematched(fitted.unknowns), fitted.unknowns, bounds=settings.bounds, tolerance=TO_THE_NOISE
    )
    return with_found_noise(objective, nearby), rest, fitted, nearby


def _from_starts(
    objective: Objective, settings: InversionSettings, coefficients: NDArray[np.float64], progress: Progress
) -> list[Minimum]:
    """A minimum from every start, the first with given coefficients (n_coefficients,), the others with its result."""
    minima: list[Minimum] = []
    for number, theta in enumerate(settings.starts, start=1):
        begin = np.concatenate([theta, minima[0].unknowns[len(theta) :] if minima else coefficients])
        found = minimised(objective, begin, settings, tolerance=None, known=minima)
        minima.append(found)
        progress(f"start {number} of {len(settings.starts)}: {len(found.history)} steps, {found.outcome.value}")
    return minima


def _another(
    best: OuterIterate, minimum: Minimum, settings: InversionSettings, rule: StopRule, progress: Progress
) -> OuterIterate:
    """Where another minimum ends under the best one's objective; followed on its own where it is lower there.

    It begins with the drivers' coefficients of the best one, which the outer loop has refined.
    """
    n = best.objective.n_parameters
    start = np.concatenate([minimum.unknowns[:n], best.minimum.unknowns[n:]])
    found = minimised(best.objective, start, settings, tolerance=OTHER)
    if found.converged and not as_good(best.minimum.evaluation.value, found.evaluation.value):
        title = "linear law, another minimum"
        end = run_outer_loop(updated(best.objective, found, rule), settings, rule, progress=progress, title=title)
        return replace(end, checks=best.checks + end.checks)
    return replace(best, minimum=found)


def _coarse(linear: OuterIterate) -> tuple[Objective, list[FiniteStrainEquilibrium]]:
    """The objective of a linear minimum on no approximation, and the coarse equilibria there of every state.

    Its states bend as the linear law does.
    """
    before, places = linear.objective, linear.objective.places(linear.minimum.unknowns)
    found, states = list[FiniteStrainEquilibrium](), list[LaterState]()
    for state, basis, place in zip(before.states, before.approximations, places, strict=True):
        assert state.finite_strain is not None
        found.append(coarse_equilibrium(state.finite_strain, basis, place))
        states.append(replace(state, approximation=None, bending=state.observed))
    return replace(before, states=tuple(states)), found


def _expanded(
    objective: Objective, coarse: Sequence[FiniteStrainEquilibrium], minimum: Minimum, progress: Progress
) -> OuterIterate:
    """A linear minimum on expansions around the equilibria there."""
    first = [expansion_around(equilibrium, tolerance=EQUILIBRIUM, progress=progress) for equilibrium in coarse]
    objective = objective.under(first).rematched(minimum.unknowns)
    return OuterIterate(objective, replace(minimum, evaluation=objective(minimum.unknowns), evaluations=1))


def _at_equilibrium(end: OuterIterate, before: tuple[Iterate, ...]) -> OuterIterate:
    """The end of an outer loop at exact equilibria; `before`: the way to where it began."""
    exact = []
    places = end.objective.places(end.minimum.unknowns)
    for approximation, place in zip(end.objective.approximations, places, strict=True):
        assert isinstance(approximation, Expansion)
        exact.append(approximation.at_equilibrium(place, tolerance=ACCURACY))
    final = end.objective.under(exact)
    evaluation, spent = final(end.minimum.unknowns), end.minimum.evaluations + 1
    minimum = replace(end.minimum, evaluation=evaluation, evaluations=spent, history=before + end.minimum.history)
    return replace(end, objective=final, minimum=minimum)


def _concluded(
    followed: Sequence[OuterIterate],
    starts: tuple[StartRun, ...],
    rest: Evaluation,
    settings: InversionSettings,
    first: int,
) -> Inversion:
    """The distinct ones of the iterates, compared with each other; `first`: the number of the one sought first."""
    n = followed[0].objective.n_parameters
    groups = _groups([iterate.minimum for iterate in followed], n)
    distinct = []
    for group in range(max(groups) + 1):  # stood for by the one sought first, else one that converged
        members = [i for i, of in enumerate(groups) if of == group]
        distinct.append(followed[min(members, key=lambda i: (i != first, not followed[i].minimum.converged, i))])
    values, evaluations = _values(distinct, settings)
    candidates = tuple(Candidate(iterate, value) for iterate, value in zip(distinct, values, strict=True))
    usable = [c.value if c.minimum.converged else np.inf for c in candidates]
    best = int(np.argmin(usable)) if np.isfinite(usable).any() else groups[first]
    joined = tuple(replace(start, candidate=groups[start.candidate]) for start in starts)
    return Inversion(candidates, best, joined, rest, evaluations, SolveCounts())


def _values(distinct: Sequence[OuterIterate], settings: InversionSettings) -> tuple[list[float], int]:
    """The iterates' values under one objective, each at its minimum under that, and what it cost in evaluations.

    Each iterate has noise models, weights and a prior of its own, and a worse fit is a smaller value where the noise is
    believed to be larger: all are compared under the objective of the one with the least noise, on their own
    approximations. Least is the geometric mean of the observations' standard deviations: each of them counts as a
    ratio, so that no kind decides by its unit or size. The evidence of each under its own objective is no way out: a
    robust loss with its own cutoff is the logarithm of no density.
    """
    if len(distinct) == 1:
        return [distinct[0].minimum.evaluation.value], 0
    usable = [iterate for iterate in distinct if iterate.minimum.converged] or list(distinct)
    reference = min(usable, key=lambda iterate: sum(np.log(o.noise_model.sd) for o in iterate.objective.observations))
    values, evaluations = [], 0
    for iterate in distinct:
        unknowns = iterate.minimum.unknowns
        same = reference.objective.under(iterate.objective.approximations).rematched(unknowns)
        there = minimised(same, unknowns, settings, tolerance=OTHER)
        values.append(there.evaluation.value)
        evaluations += there.evaluations
    return values, evaluations


def _remembered(minimum: Minimum) -> Minimum:
    """The minimum without its residuals and their derivatives, which are large where many unknowns are seen."""
    return replace(minimum, evaluation=replace(minimum.evaluation, lines=()))


def _best(minima: Sequence[Minimum]) -> int:
    """Number of the converged minimum with the smallest value; of them all when none converged."""
    return min(range(len(minima)), key=lambda i: (not minima[i].converged, minima[i].evaluation.value))


def _groups(minima: Sequence[Minimum], n_parameters: int) -> list[int]:
    """Number of the distinct minimum that each one is, in their order."""
    distinct: list[Minimum] = []
    groups = []
    for minimum in minima:
        same = [i for i, other in enumerate(distinct) if same_minimum(minimum.unknowns, other, n_parameters)]
        if not same:
            distinct.append(minimum)
        groups.append(same[0] if same else len(distinct) - 1)
    return groups
