"""The loop that lowers the objective: linearise the model, minimise over unknowns and hyper-parameters, accept, repeat.

It is the same for the linear and for a finite-strain law, and for every approximation of the model.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from enum import StrEnum

import numpy as np
from numpy.typing import NDArray

from palpate.approximation.contract import Approximation, ModelError, updated
from palpate.approximation.expansion import Expansion
from palpate.errors import NotConverged
from palpate.inversion.frozen_posterior import cheapest_minima
from palpate.inversion.hyper_parameters import with_correlations, with_hyper_parameters
from palpate.inversion.objective import AS_GOOD, Evaluation, LinearisedObjective, Objective
from palpate.inversion.optimise import (
    BAD,
    TRIALS,
    Bounds,
    Iterate,
    Minimum,
    Outcome,
    TrustRegion,
    gauss_newton,
    newton_step,
    posterior_sd,
)
from palpate.mechanics.equilibrium import ACCURACY
from palpate.mechanics.forward import SolveCounts
from palpate.observation.contract import seen_by
from palpate.parallel import both
from palpate.progress import silent

NOISE = 0.5  # error of the objective from closest points that slide over voxels (Sun & Nocedal 2023, Math. Program.)
INNER = 1e-4  # fall of the objective, by unknowns or hyper-parameters, at which a minimum on linear residuals ends
SETTLES = 6  # how often the numbers of independent residuals are taken anew before they stay
TRIED = 4  # iterations after blocks have chosen anew, within which J must fall below its earlier minimum


class Criterion(StrEnum):
    """Conditions of convergence; the value is what the user reads where one does not hold."""

    STEP = "the estimate still moves from iteration to iteration"
    LINEARISATION = "the estimate still moves when the model is linearised again"
    MODEL_ERROR = "the reduced model is not accurate enough at the estimate"


@dataclass(frozen=True, slots=True)
class Convergence:
    """What an iteration left unmet, each over its tolerance: converged where none exceeds 1."""

    step: float = np.inf
    linearisation: float = np.inf
    model_error: float = np.inf

    @property
    def unmet(self) -> tuple[Criterion, ...]:
        """The criteria that do not hold."""
        return tuple(c for c in Criterion if getattr(self, c.name.lower()) >= 1.0)

    @property
    def converged(self) -> bool:
        """Whether all hold."""
        return not self.unmet


@dataclass(frozen=True, slots=True)
class StopRule:
    """When an estimate ends, in its own posterior standard deviations.

    step_sd, floor: a log-modulus may still move by so many of its standard deviations, or by `floor` (of ln E) where
    that is more; coefficients: the decrement a coefficient that may be left; model_error: share of the tolerance by
    which what the approximation misses may set it off (J by its noise, and a share of what a step promises), inf: none
    is asked for; derivatives: whether those that decide
    the moduli must be exact so near; all_material: whether those by all material modes are made so with them; learn:
    whether hyper-parameters are sought, too; correlate: whether the numbers of independent residuals are taken anew;
    iterations: the largest number, in the second half of which the trust region grows no more and no alternative is
    chosen anew, so that none comes and goes.
    """

    step_sd: float = 0.02
    floor: float = 3e-4
    coefficients: float = np.inf
    model_error: float = 1.0
    derivatives: bool = True
    all_material: bool = True
    learn: bool = True
    correlate: bool = True
    iterations: int = 25

    def tolerance(self, minimum: Minimum, n_parameters: int) -> NDArray[np.float64]:
        """By how much each log-modulus (n_parameters,) may still move."""
        if np.isinf(self.step_sd):
            return np.full(n_parameters, np.inf)
        return np.maximum(self.step_sd * posterior_sd(minimum, n_parameters), self.floor)


REPORTED = StopRule()  # of an estimate
NEAR = StopRule(step_sd=0.2)  # of a start that is followed further, and of an interval: a tenth of its half-width


@dataclass(frozen=True, slots=True)
class OuterIterate:
    """Where an iteration ended: a minimum under the objective that it was found with.

    checks: what it cost to state the approximations' errors; totals: J before and after each accepted step, by one
    linearisation's determinants; correlated: how often a step was so short that the numbers of independent residuals
    could be taken anew.
    """

    objective: Objective
    minimum: Minimum
    convergence: Convergence = Convergence()
    checks: SolveCounts = field(default_factory=SolveCounts)
    totals: tuple[tuple[float, float], ...] = ()
    correlated: int = 0

    @property
    def counts(self) -> SolveCounts:
        """What the full model has cost: to make the approximations, and to state their errors."""
        return sum((approximation.counts for approximation in self.objective.approximations), self.checks)

    def at_equilibrium(self) -> OuterIterate:
        """The same at exact equilibria of its expansions."""
        exact, at = list[Approximation](), self.minimum
        points = self.objective.linearisation_points(at.unknowns)
        for approximation, point in zip(self.objective.approximations, points, strict=True):
            assert isinstance(approximation, Expansion)
            exact.append(approximation.at_equilibrium(point, tolerance=ACCURACY))
        objective = self.objective.under(exact)
        minimum = replace(at, evaluation=objective(at.unknowns), evaluations=at.evaluations + 1)
        return replace(self, objective=objective, minimum=minimum)


def begun(
    objective: Objective, unknowns: NDArray[np.float64], *, history: tuple[Iterate, ...] = (), evaluations: int = 0
) -> OuterIterate:
    """Where a loop begins: an objective matched, and evaluated, at unknowns (n_unknowns,).

    history, evaluations: the way there, and what it cost.
    """
    objective = objective.rematched(unknowns)
    evaluation = objective(unknowns)
    history = (*history, Iterate.of(unknowns, evaluation, objective.n_parameters))
    return OuterIterate(objective, Minimum(unknowns, evaluation, Outcome.STEPS, history, evaluations + 1))


def predicted(before: OuterIterate, bounds: Bounds) -> OuterIterate:
    """Where a loop begins after `before` with those blocks free that were fixed (see `Block.released`).

    At the minimum on the cheapest model, or on the way there as far as models are trusted.
    """
    at = before.minimum
    objective, evaluation = before.objective.released(at.evaluation, at.unknowns)
    (found,) = cheapest_minima(objective, at.unknowns, evaluation, [at.unknowns], bounds)
    away = found.unknowns - at.unknowns if found.converged else np.zeros(len(at.unknowns))
    moduli = np.append(np.arange(objective.n_parameters), objective.parameters.acting_on_moduli)
    furthest = float(np.max(np.abs(away[moduli]), initial=0.0))
    trusted = min(approximation.trust_radius for approximation in objective.approximations)
    unknowns = at.unknowns + min(1.0, trusted / max(furthest, 1e-9)) * away
    return replace(begun(objective, unknowns, history=at.history, evaluations=at.evaluations), checks=before.checks)


@dataclass(frozen=True, slots=True)
class _Step:
    """A step to a minimum on linear residuals: unknowns, hyper-parameters there, and J at both ends.

    begin: the evaluation at its start, under these hyper-parameters; cut: whether the trust region ended it; settled:
    whether it is so short that its residuals show no motion any more, and so tell how many of them are independent.
    """

    objective: Objective
    minimum: Minimum
    begin: Evaluation
    now: float
    then: float
    cut: bool
    settled: bool

    def total(self, there: Evaluation) -> float:
        """J where it ends, by the determinants on linear residuals, from its evaluation there."""
        return self.then + there.value - self.minimum.evaluation.value

    def reductions(self, unknowns: NDArray[np.float64], there: Evaluation) -> tuple[float, float]:
        """By how much J falls on a way d from unknowns (n,): at the evaluated end, and on linear residuals.

        The scores s, s' at both ends give -1/2 (s + s')^T d. Closest points that slide over voxels add noise to J, as
        large as the expected fall. The scores, by the Jacobians of smooth surfaces, do not have it. Where J itself
        falls by more, that counts, because on a long way the score does not change evenly.
        """
        d = self.minimum.unknowns - unknowns
        ends = there.score, self.minimum.evaluation.score
        gain, promised = (-0.5 * float((self.begin.score + end) @ d) for end in ends)
        return max(gain, self.begin.value - there.value), promised

    def remaining(
        self, unknowns: NDArray[np.float64], there: Evaluation, bounds: Bounds
    ) -> tuple[list[NDArray[np.float64]], bool]:
        """Steps (n,) that may still be missing after one from unknowns (n,); whether they are across that one.

        They are the step itself and, where the trust region cut it, the step -H^-1 s that is left at its end. Suppose
        that J is no lower and the score still leads on by more than half of the step. Then only the part across the
        step counts: errors of the normals pull a wall along itself everywhere alike, and no residual falls by it.
        """
        end, n = self.minimum.unknowns, self.objective.n_parameters
        taken, onward = end - unknowns, newton_step(there, bounds.free(end, there.score), n)
        along = float(taken @ there.matrix @ onward) / max(float(taken @ there.matrix @ taken), 1e-30)
        if not self.cut and along > 0.5 and self.total(there) >= self.now:
            return [onward - along * taken], True
        return [taken, onward] if self.cut else [taken], False


def minimised(
    start: OuterIterate,
    bounds: Bounds,
    rule: StopRule,
    *,
    progress: Callable[[str], None],
    title: str,
) -> OuterIterate:
    """Lower the objective from `start` until a stop rule is met.

    Where it is met the blocks choose their alternatives afresh, and the loop goes on from there; of the minima that it
    finds so the likeliest is returned. `title` begins each line of `progress`.
    History and evaluations are added to those of `start`. Raises `NotConverged` when the full model has no equilibrium
    where every trial leads.
    """
    now = replace(start, minimum=replace(start.minimum, outcome=Outcome.STEPS), totals=(), correlated=0)
    del start
    region, ends, last = TrustRegion(), list[OuterIterate](), 0
    for number in range(1, rule.iterations + 1):
        heading, early = f"{title}, iteration {number}", 2 * number <= rule.iterations
        lowered = f", objective {now.totals[-1][0]:.2f} to {now.totals[-1][1]:.2f}" if now.totals else ""
        progress(f"{heading}: {now.objective.parameters.in_words(now.minimum.unknowns)}{lowered}")
        now, region = _iteration(now, bounds, rule, region, grows=early)
        if now.minimum.outcome is Outcome.STUCK:
            break
        if ends and number == last + TRIED and total_counted_as(now, now) >= total_counted_as(ends[-1], now):
            break
        if now.convergence.converged:
            last = number
            ends.append(replace(now, minimum=replace(now.minimum, outcome=Outcome.CONVERGED)))
            now = _chosen_afresh(now) if rule.learn and early else now
            if _numbers(now.objective) in [_numbers(end.objective) for end in ends]:
                break
    return _likeliest(ends, now) if ends else now


def fit_coefficients(objective: Objective, begin: NDArray[np.float64]) -> Minimum:
    """The best coefficients of the blocks at the log-moduli of `begin` (n_unknowns,), sought from there.

    To a fifth of their standard deviations each, in the mean.
    """
    rule = StopRule(step_sd=np.inf, coefficients=0.02, model_error=np.inf, derivatives=False, learn=False)
    theta = begin[: objective.n_parameters]
    return minimised(begun(objective, begin), Bounds(theta, theta), rule, progress=silent, title="coefficients").minimum


def _iteration(
    now: OuterIterate, bounds: Bounds, rule: StopRule, region: TrustRegion, *, grows: bool
) -> tuple[OuterIterate, TrustRegion]:
    """One accepted step, or `STUCK` where no trial is accepted; and the trust region for the next one.

    A step with other alternatives is taken only where J rises by no more than `AS_GOOD`. Else the linear residuals
    promised what does not hold at its end, and the step is taken again without them. So is a step with the first choice
    that gains too little. By a first choice J may rise, because its priors were others before. grows: whether the
    region may grow.
    """
    n, before = now.objective.n_parameters, now.minimum
    moduli = np.append(np.arange(n), now.objective.parameters.acting_on_moduli)
    failure, trial_evaluations, lost = None, 0, np.inf
    for _ in range(TRIALS):
        step = _linear_minimum(now, bounds, rule, region)
        moved = np.abs(step.minimum.unknowns - before.unknowns)
        longest = float(np.max(moved[moduli], initial=0.0))
        try:
            there, spent = _evaluated(step, now, bounds, rule)
        except NotConverged as error:
            failure, region = error, region.smaller(longest)
            continue
        failure, trial_evaluations = None, trial_evaluations + spent
        seen = there.minimum.evaluation
        then = step.total(seen)
        gain, promised = step.reductions(before.unknowns, seen)
        others, first = _numbers(step.objective) != _numbers(now.objective), not now.objective.chosen
        if (gain + NOISE) / (promised + NOISE) > BAD and (first or not others or then - step.now <= AS_GOOD):
            region = region.after(gain / max(promised, 1e-9), longest, grows=grows)
            end, spent = there.minimum, before.evaluations + trial_evaluations
            end = replace(end, history=(*before.history, Iterate.of(end.unknowns, seen, n)), evaluations=spent)
            totals = (*now.totals, (step.now, then))
            return replace(there, minimum=end, totals=totals), region
        if others:
            rule = replace(rule, learn=False)
        else:
            region, lost = region.smaller(longest, damps=promised - gain > 0.5 * lost), promised - gain
    if failure is not None:
        raise failure
    spent = before.evaluations + trial_evaluations
    return replace(now, minimum=replace(before, outcome=Outcome.STUCK, evaluations=spent)), region


def _chosen_afresh(now: OuterIterate) -> OuterIterate:
    """The iterate after all blocks have chosen among their alternatives anew.

    During the search an alternative stays until another one is clearly likelier, so that it depends on the start.
    """
    at, begin = now.minimum, replace(now.objective, learn_last=True, chosen=())
    learned = with_hyper_parameters(begin, at.evaluation, at.unknowns)
    if _numbers(learned) == _numbers(now.objective):
        return now
    evaluation = LinearisedObjective(learned, at.unknowns, at.evaluation)(at.unknowns)
    return replace(now, objective=learned, minimum=replace(at, evaluation=evaluation))


def _likeliest(ends: Sequence[OuterIterate], last: OuterIterate) -> OuterIterate:
    """The minimum with the least J among those under several alternatives; its cost is that of all iterations."""
    fewest = with_fewest(ends)
    best = min(ends, key=lambda end: total_counted_as(end, fewest))
    if best.minimum.evaluations == last.minimum.evaluations:
        return best
    spent = last.counts - replace(best, checks=SolveCounts()).counts
    return replace(best, minimum=replace(best.minimum, evaluations=last.minimum.evaluations), checks=spent)


def total_counted_as(iterate: OuterIterate, other: OuterIterate) -> float:
    """J where an iteration ended, with the numbers of independent residuals of another one."""
    objective, at = iterate.objective.counted_as(other.objective), iterate.minimum
    return objective.total(LinearisedObjective(objective, at.unknowns, at.evaluation)(at.unknowns))


def with_fewest(iterates: Sequence[OuterIterate]) -> OuterIterate:
    """The one with the fewest independent residuals, by which all are compared, of those that converged where one did.

    These numbers are data of an objective, and by too many of them what explains smooth noise seems clearly likelier.
    """
    ended = [iterate for iterate in iterates if iterate.minimum.converged]
    return min(ended or iterates, key=lambda iterate: iterate.objective.n_independent)


def _numbers(objective: Objective) -> tuple[int | None, ...]:
    """Numbers of the alternatives that blocks have chosen; None for a block without alternatives or choice."""
    return objective.chosen or (None,) * len(objective.parameters.blocks)


def _linear_minimum(start: OuterIterate, bounds: Bounds, rule: StopRule, region: TrustRegion) -> _Step:
    """Unknowns and hyper-parameters with the least objective on residuals linear around the present minimum.

    Unknowns and hyper-parameters (see `with_hyper_parameters`) are minimised in turn, each of which lowers J. Where the
    step is damped the hyper-parameters stay. The numbers of independent residuals are first taken before blocks have
    their first alternative: with too many, a frame or a wall that follows smooth noise seems certain. They are taken
    anew `SETTLES` times, after steps that the trust region did not cut and that are shorter than a standard deviation
    of each log-modulus. Residuals after longer steps contain motion, which is alike over whole surfaces.
    """
    objective, at, n = start.objective, start.minimum, start.objective.n_parameters
    trusted = [state.approximation.trust_radius for state in objective.states if state.approximation]
    theta, radius = at.unknowns[:n], min([region.radius, *trusted])
    near = Bounds(np.maximum(bounds.lower, theta - radius), np.minimum(bounds.upper, theta + radius))
    damping, within = region.damping, 0.05 * rule.tolerance(at, n)

    def least(linear: LinearisedObjective, begin: NDArray[np.float64]) -> tuple[Minimum, bool]:
        """The minimum, or the point towards it up to which layers' moduli may go; whether it was shortened so."""
        found = gauss_newton(linear, begin, bounds=near, tolerance=INNER, within=within)
        whole = found.unknowns - at.unknowns
        furthest = float(np.max(np.abs(whole[objective.parameters.acting_on_moduli]), initial=0.0))
        if furthest <= radius and not linear.damping:
            return found, False
        unknowns = at.unknowns + radius / furthest * whole if furthest > radius else found.unknowns
        there = replace(found, unknowns=unknowns, evaluation=replace(linear, damping=0.0)(unknowns))
        return there, furthest > radius

    found, shortened = least(LinearisedObjective(objective, at.unknowns, at.evaluation, damping), at.unknowns)
    theta = found.unknowns[:n]
    low, high = (theta <= near.lower) & (near.lower > bounds.lower), (theta >= near.upper) & (near.upper < bounds.upper)
    cut = damping > 0.0 or shortened or bool(np.any(low | high))
    now, total = objective.total(at.evaluation), objective.total(found.evaluation)
    if damping or not rule.learn:
        return _Step(objective, found, at.evaluation, now, total, cut, settled=False)
    settled = not cut and bool(np.all(np.abs(found.unknowns - at.unknowns)[:n] < posterior_sd(found, n)))
    choosing = not objective.chosen and any(b.odds and not b.last for b in objective.parameters.blocks)
    if rule.correlate and (settled or choosing) and start.correlated < SETTLES:
        objective = with_correlations(objective, found.evaluation)
        found = replace(found, evaluation=LinearisedObjective(objective, at.unknowns, at.evaluation)(found.unknowns))
        plain = LinearisedObjective(objective, found.unknowns, found.evaluation)
        now, total = objective.total(plain(at.unknowns)), objective.total(found.evaluation)
    for _ in range(rule.iterations):
        learned = with_hyper_parameters(objective, found.evaluation, found.unknowns)
        linear = LinearisedObjective(learned, found.unknowns, found.evaluation)
        again, shortened = least(linear, found.unknowns)
        lower = learned.total(again.evaluation)
        if lower > total:
            break
        moved = np.abs(again.unknowns - found.unknowns)[:n] / rule.tolerance(again, n)
        change, objective, found, total, cut = total - lower, learned, again, lower, cut or shortened
        if np.all(moved < 0.1) and change < INNER:
            break
    begin = LinearisedObjective(objective, found.unknowns, found.evaluation)(at.unknowns)
    return _Step(objective, found, begin, now, total, cut, settled)


def _evaluated(step: _Step, now: OuterIterate, bounds: Bounds, rule: StopRule) -> tuple[OuterIterate, int]:
    """The objective at the end of a step, with the model made exact there where its error matters; the evaluations.

    Where derivatives that decide the moduli come from too far away, the model is made exact in any case. After a step
    shorter than a standard deviation this is done at once, along the directions that decide on linear residuals.
    """
    n, before, unknowns = step.objective.n_parameters, now.minimum, step.minimum.unknowns
    objective, minimum = step.objective.rematched(unknowns), replace(step.minimum, outcome=Outcome.STEPS)
    asked, checks, spent, left, missing = np.isfinite(rule.model_error), now.checks, 0, 0.0, 0.0
    if asked and rule.derivatives:
        left = linearisation_distance(objective, unknowns) / rule.step_sd
    states_error = asked and left < 1.0
    if left < 1.0 or not step.settled:
        evaluation, errors = both(
            lambda: objective(unknowns), lambda: model_errors(objective, unknowns) if states_error else []
        )
        minimum, spent = replace(minimum, evaluation=evaluation), 1
        if states_error:
            off, rise = set_off(objective, minimum, errors)
            _, promised = step.reductions(before.unknowns, evaluation)
            missing = float(np.max(off / (rule.model_error * rule.tolerance(minimum, n)), initial=0.0))
            missing = max(missing, abs(rise) / (NOISE + BAD * max(promised, 0.0)))
            checks = sum((approximation.error_counts for approximation in objective.approximations), checks)
    exact = max(missing, left) >= 1.0
    if exact:
        points = objective.linearisation_points(unknowns, minimum.evaluation, all_material=rule.all_material)
        objective = objective.under(updated(objective.approximations, points))
        minimum, spent = replace(minimum, evaluation=objective(unknowns)), spent + 1
    steps, across = step.remaining(before.unknowns, minimum.evaluation, bounds)
    tolerance = rule.tolerance(minimum, n)
    wanted = max(float(np.max(np.abs(d[:n]) / tolerance, initial=0.0)) for d in steps)
    if np.isfinite(rule.coefficients):
        decrement = max(0.5 * float(d @ before.evaluation.matrix @ d) for d in steps)
        wanted = max(0.0 if np.isinf(rule.step_sd) else wanted, decrement / (rule.coefficients * len(unknowns)))
    if exact and across:
        left = missing = 0.0
    convergence, correlated = Convergence(wanted, left, missing), now.correlated + step.settled
    return OuterIterate(objective, minimum, convergence, checks, now.totals, correlated), spent


def linearisation_distance(objective: Objective, unknowns: NDArray[np.float64]) -> float:
    """The largest distance d of ln E at unknowns (n_unknowns,) from where an approximation's derivatives are exact.

    There they are off by a share d, and so is what the residuals pull with them, which is one posterior standard
    deviation: an estimate is set off by d of them. Infinite where they are exact nowhere yet.
    """
    moduli, distance = objective.parameters.moduli(unknowns), 0.0
    for approximation in objective.approximations:
        exact = approximation.derivatives_at
        distance = np.inf if exact is None else max(distance, float(np.abs(np.log(moduli / exact)).max()))
    return distance


def model_errors(objective: Objective, unknowns: NDArray[np.float64]) -> list[ModelError]:
    """What the approximation of each state misses at unknowns (n_unknowns,), by one right-hand side each."""
    pairs = zip(objective.approximations, objective.linearisation_points(unknowns), strict=True)
    return [approximation.error(at) for approximation, at in pairs]


def set_off(objective: Objective, minimum: Minimum, errors: Sequence[ModelError]) -> tuple[NDArray[np.float64], float]:
    """What comes of what the approximations miss at a minimum, by the `errors` of each state's.

    By how much it sets the log-moduli off (n_parameters,), |H^-1 J^T W S du|, and by how much larger J is on the exact
    model, r^T W S du + 1/2 du^T S^T W S du, dimensionless: with the displacement du that is missing, the residuals'
    derivatives S by it and the Gauss-Newton matrix H = J^T W J + P. Infinite where an approximation cannot say.
    """
    if not np.isfinite(max(error.relative for error in errors)):
        return np.full(objective.n_parameters, np.inf), np.inf
    pull, rise = np.zeros(len(minimum.unknowns)), 0.0
    for term in minimum.evaluation.linearisations:
        du = seen_by(term.observation, errors[term.state].missing)
        missing, believed = np.asarray(term.residuals.jacobian @ du), term.precision * term.weights
        pull[term.columns] += term.jacobian.transposed_times(believed * missing)
        rise += float(believed @ (missing * (term.residuals.values + 0.5 * missing)))
    off = np.abs(minimum.evaluation.covariance_columns(objective.n_parameters).T @ pull)
    return np.asarray(off), rise
