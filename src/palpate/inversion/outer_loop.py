"""The outer loop of an estimate: reweight, step, update the approximation, until one stop rule is met.

It is the same for the linear and for a finite-strain law, and for every approximation of the model.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from enum import StrEnum

import numpy as np
from numpy.typing import NDArray

from palpate.errors import NotConverged
from palpate.inversion.approximation import Approximation, Derivatives
from palpate.inversion.objective import Evaluation, LinearisedObjective, Objective
from palpate.inversion.optimise import (
    Bounds,
    Iterate,
    Minimum,
    Outcome,
    gauss_newton,
    lbfgs,
    newton_decrement,
    posterior_sd,
)
from palpate.inversion.reweighting import reweighted
from palpate.mechanics.forward import SolveCounts
from palpate.observation.contract import seen_by

FORCING = 0.1  # of the last outer iteration's step: to which the next one's weights and estimate agree
INNER = 20.0  # a minimum is found to so small a part of what a reweighting may still change
POLISH, ROUGHLY = 1e-5, 1e-2  # decrements of a minimum by a method that does not tell how far the log-moduli are
WIDTH = 0.05  # of a posterior standard deviation, by which a reweighting may still change it
AGREED = 0.3  # of that tolerance, to which weights and estimate agree on linearised residuals
FIRST = 10.0  # tolerances, to which they agree there at the least, however far the estimate still is
LINEARISED = 1e-4  # decrement of a minimum on them
STRAIGHT = 0.4  # of ln E, within which linearised residuals are believed
WITHIN_NOISE = 0.1  # of the posterior's width: a step that finds no smaller value, what a start may miss
NEAR = 0.5  # posterior standard deviations: a shorter step ends where exact derivatives are worth it, and a held prior
LEAST_SD = 0.03  # of ln E, see `_linearisation`
RELEARNED = 1  # times at the most that the blocks' prior is learned anew where the estimate had converged
PRIOR_HOLDS = 2.5  # tolerances, by which an estimate would move, or what is known of it, if it were learned anew there
AFTER_CHANGE = 4  # outer iterations that must be left for another prior: what converged is not lost
SLOW = 0.5  # of the model's error an outer iteration before: where more is left all derivatives are made exact
DAMPED_AFTER = 2  # passes of weights and estimate in turn: a later one that turns back goes half its way
TURNED = 0.5  # of the last outer iteration's step: one that leads back by more goes half its way
HALVINGS = 3
TRUSTED = 0.03  # error in energy of an approximation, below which the step on it needs no line search
ROUGHNESS = 0.5  # of the objective, in units of log-likelihood: the noise of re-chosen closest points


@dataclass(frozen=True, slots=True)
class InversionSettings:
    """Starts theta (n_parameters,) each, their bounds, the optimiser's name."""

    starts: tuple[NDArray[np.float64], ...]
    bounds: Bounds
    method: str = "gauss-newton"


class Criterion(StrEnum):
    """What must hold for an estimate to end; the value is what the user reads where it does not."""

    REWEIGHTING = "the residuals' weights and the estimate still change each other"
    LINEARISATION = "the estimate still moves where the model is linearised anew"
    MODEL_ERROR = "the model that stands in for the full one is not exact enough where the estimate lies"


@dataclass(frozen=True, slots=True)
class Convergence:
    """What an outer iteration left open, each over its tolerance: converged where none exceeds 1."""

    reweighting: float = np.inf
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
    that is more; model_error: share of that by which what the approximation misses may set it off; derivatives: whether
    those that decide the moduli must be exact so near that they leave no more than a step; solve_above: error from
    which the full model is solved; passes, of weights and estimate in turn on one approximation, and
    iterations: the largest numbers of each; far: tolerances by which an estimate may still move
    where more iterations do no better: at the largest number of them, where more has not converged, and where the
    passes of one lead back to where it began (weightings that explain the images as well take turns); where they end
    with more, of whichever criterion, nothing has converged.
    """

    step_sd: float = 0.02
    floor: float = 3e-4
    model_error: float = 0.5
    derivatives: bool = True
    solve_above: float = 0.0
    passes: int = 6
    iterations: int = 16
    far: float = 5.0

    def tolerance(self, minimum: Minimum, n_parameters: int) -> NDArray[np.float64]:
        """By how much each log-modulus (n_parameters,) may still move."""
        return np.maximum(self.step_sd * posterior_sd(minimum, n_parameters), self.floor)


@dataclass(frozen=True, slots=True)
class OuterIterate:
    """Where an outer iteration ended: a minimum under the objective that it was found with.

    step: how far it moved a log-modulus, over the stop rule's tolerance; stayed: whether no part of the step lowered
    the objective, so that it ended where it began; checks: what it cost to state the approximations' errors.
    """

    objective: Objective
    minimum: Minimum
    convergence: Convergence = Convergence()
    step: float = np.inf
    stayed: bool = False
    checks: SolveCounts = field(default_factory=SolveCounts)

    @property
    def counts(self) -> SolveCounts:
        """What the full model has cost: to make the approximations, and to state their errors."""
        return sum((approximation.counts for approximation in self.objective.approximations), self.checks)


def run_outer_loop(
    start: OuterIterate, settings: InversionSettings, rule: StopRule, *, progress: Callable[[str], None], title: str
) -> OuterIterate:
    """Follow a minimum until reweighting it and updating its approximations change it no more.

    Of the approximations of `start` see `updated`. What is believed of the blocks is held from where the estimate is
    near, and learned once more, then of those that are learned last, too, where, learned at the estimate, it would not
    leave that where it is. `title` begins each line of `progress`. The minimum's history is that of the loop alone, its
    evaluations are added to those of `start`. Raises `NotConverged` when the full model has no equilibrium where every
    part of a step leads.
    """
    at, theta = start.minimum.evaluation, start.minimum.unknowns[: start.objective.n_parameters]
    first = Iterate(theta, at.value, at.misfit_mm2, newton_decrement(at))
    now = replace(start, minimum=replace(start.minimum, history=(first,)))
    held, relearned, last = False, 0, np.zeros(len(start.minimum.unknowns))
    del start  # and with it its approximations, which are large, when others take their place
    for number in range(1, rule.iterations + 1):
        line = f"{title}, outer iteration {number}"
        progress(f"{line}: {now.objective.parameters.in_words(now.minimum.unknowns)}")
        before = now.minimum.unknowns
        now = _iteration(now, last, settings, rule, progress, line)
        last = now.minimum.unknowns - before
        if now.stayed:
            break
        if not held and _near(now.minimum, before, now.objective.n_parameters):
            # Learned anew at every step it follows the estimate, which follows it: the wall slides off along itself.
            now, held = _learning(now, held=True), True
        if now.convergence.converged:
            last = np.zeros_like(last)  # what follows is another objective
            if number > rule.iterations - AFTER_CHANGE:
                break
            free = replace(_learning(now, held=False, last_held=False), convergence=Convergence())
            if not held or relearned == RELEARNED or _prior_holds(free, settings, rule):
                break
            now, held, relearned = free, False, relearned + 1
    else:
        open_ = now.convergence
        most = max(open_.reweighting, open_.linearisation, open_.model_error)
        if most > rule.far and now.minimum.converged:
            now = replace(now, minimum=replace(now.minimum, outcome=Outcome.STEPS))
    return _learning(now, held=False)  # another law learns anew


def _prior_holds(free: OuterIterate, settings: InversionSettings, rule: StopRule) -> bool:
    """Whether the blocks' prior, learned anew at an estimate that held it, would leave the estimate as it is."""
    found = _agreed(free.objective, free.minimum, settings.bounds, settings.bounds, rule, 1.0)[1]
    return _change(free.minimum, found, rule, free.objective.n_parameters) < PRIOR_HOLDS


def _learning(now: OuterIterate, *, held: bool, last_held: bool | None = None) -> OuterIterate:
    """The iterate whose blocks' prior is held, or learned with every reweighting; of those learned last as it was."""
    last = now.objective.last_held if last_held is None else last_held
    return replace(now, objective=replace(now.objective, prior_held=held, last_held=last))


def updated(objective: Objective, minimum: Minimum, rule: StopRule) -> OuterIterate:
    """A minimum on approximations that are made exact there: what they miss would pass for noise.

    Unless that moves no log-modulus by a tenth of its posterior standard deviation, or the rule asks for less.
    """
    error, off, cost = _model_error(objective, minimum)
    now = OuterIterate(objective, minimum, checks=cost)
    if error < rule.solve_above or np.all(off < WITHIN_NOISE * posterior_sd(minimum, objective.n_parameters)):
        return now
    return _with_approximations(now, _solved(objective, minimum.unknowns, minimum.evaluation))


def minimised(
    objective: Objective,
    start: NDArray[np.float64],
    settings: InversionSettings,
    *,
    tolerance: float | None = 1e-3,
    within: NDArray[np.float64] | float = np.inf,
    known: Sequence[Minimum] = (),
) -> Minimum:
    """The minimum from `start` (n_unknowns,) by the method of the settings.

    `tolerance` of the decrement, None: as `gauss_newton` has it; `within` (one, or (n_parameters,)): how far the
    log-moduli may yet be from it; `known`: minima that may end Gauss-Newton where it meets one.
    """
    if settings.method == "lbfgs":
        polish = POLISH if np.all(np.isfinite(within)) else ROUGHLY if tolerance is None else tolerance
        return lbfgs(objective, start, bounds=settings.bounds, tolerance=polish)
    return gauss_newton(objective, start, bounds=settings.bounds, tolerance=tolerance, within=within, known=known)


def _iteration(
    now: OuterIterate,
    last: NDArray[np.float64],
    settings: InversionSettings,
    rule: StopRule,
    progress: Callable[[str], None],
    line: str,
) -> OuterIterate:
    """Reweight and minimise on the present approximations, and update these there, or on a part of the way.

    last (n_unknowns,): the step of the iteration before. Where weights, or approximations, at either end of it lead to
    the other, half of the way back is gone.
    """
    objective, found, reweighting = _reweighted_minimum(now, settings, rule, progress, line)
    n, way = objective.n_parameters, found.unknowns - now.minimum.unknowns
    tolerance = rule.tolerance(found, n)
    if np.any(np.abs(way[:n]) > tolerance) and last[:n] @ way[:n] < -TURNED * last[:n] @ last[:n]:
        half, spent = now.minimum.unknowns + 0.5 * way, found.evaluations + 1
        objective = objective.rematched(half)
        found = replace(found, unknowns=half, evaluation=objective(half), evaluations=spent)
    progress(f"{line}: the model's error, and the model anew, there")
    moved = np.abs(found.unknowns - now.minimum.unknowns)[:n]
    step = float(np.max(moved / tolerance, initial=0.0))
    open_ = np.max(_linearisation(objective, found) / tolerance, initial=0.0) if rule.derivatives else step
    error, off, cost = _model_error(objective, found)
    missing = float(np.max(off / (rule.model_error * tolerance), initial=0.0))
    if step < 1.0 and reweighting <= rule.far:  # its passes went round to where it began: more of them do the same
        reweighting = min(reweighting, step)
    convergence = Convergence(reweighting, float(open_), missing)
    there = OuterIterate(objective, found, convergence, step, checks=now.checks + cost)
    if convergence.converged or error < rule.solve_above:
        return there
    worth = Derivatives.KEPT
    if _near(found, now.minimum.unknowns, n):  # walls that slide by derivatives of elsewhere leave an error that stays
        slow = missing >= 1.0 and missing > SLOW * now.convergence.model_error
        worth = Derivatives.ALL if slow else Derivatives.DECIDING
    if error < TRUSTED:
        return _with_approximations(there, _solved(objective, found.unknowns, found.evaluation, worth))
    return _line_search(now, there, worth)


def _near(found: Minimum, before: NDArray[np.float64], n_parameters: int) -> bool:
    """Whether the step from unknowns (n_unknowns,) to a minimum is so short that the estimate lies near."""
    moved = np.abs(found.unknowns - before)[:n_parameters]
    return bool(np.all(moved < NEAR * posterior_sd(found, n_parameters)))


def _reweighted_minimum(
    now: OuterIterate, settings: InversionSettings, rule: StopRule, progress: Callable[[str], None], line: str
) -> tuple[Objective, Minimum, float]:
    """Iteratively reweighted minimisation on the present approximations, and what its last pass changed.

    Each pass finds weights and estimate that agree on the linearised residuals, and goes there on the objective itself.
    Where these lead further than residuals are straight, it minimises the objective itself and reweights there. It ends
    where a pass moves the log-moduli by less than the tolerance and their standard deviations by less than `WIDTH`, or
    by a tenth of the last outer iteration's step where that is more. The log-moduli go no further than the
    approximations reach; where that cuts a step short nothing is reweighted: what is still motion would pass for noise,
    and where noise is believed to be large the drivers are no longer made to follow their walls.
    """
    n, objective, minimum = now.objective.n_parameters, now.objective, now.minimum
    reach = min(approximation.reach for approximation in objective.approximations)
    theta, bounds = minimum.unknowns[:n], settings.bounds
    near = Bounds(np.maximum(bounds.lower, theta - reach), np.minimum(bounds.upper, theta + reach))
    forcing, change, minimised_before = max(1.0, FORCING * now.step), np.inf, False
    last = np.zeros(n)
    for number in range(1, rule.passes + 1):
        before, (weighted, aim, left) = minimum, _agreed(objective, minimum, near, bounds, rule, forcing)
        straight = bool(np.abs(aim.unknowns - before.unknowns)[:n].max() < STRAIGHT)
        if straight:
            way = aim.unknowns - before.unknowns
            share = 0.5 if number > DAMPED_AFTER and last @ way[:n] < 0.0 else 1.0  # it would go to and fro
            last, aimed = way[:n], before.unknowns + share * way
            objective, minimum = _advanced(weighted, minimum, aimed, replace(settings, bounds=near))
            change = max(left, _change(before, minimum, rule, n) / share)
        else:
            within = forcing * rule.tolerance(before, n) / INNER
            found = minimised(objective, before.unknowns, replace(settings, bounds=near), within=within)
            weighted = objective if _cut_short(found, near, bounds) else reweighted(objective, found)
            objective = weighted.rematched(found.unknowns)
            again, spent = objective(found.unknowns), found.evaluations + 1
            minimum = replace(found, evaluation=again, evaluations=spent).after(before)
            change = _change(before, minimum, rule, n) if minimised_before else np.inf  # of minima under two weightings
        minimised_before = not straight
        if change < forcing or not minimum.converged or _cut_short(minimum, near, bounds):
            break
        progress(f"{line}, reweighting {number}: {objective.parameters.in_words(minimum.unknowns)}")
    return objective, minimum, change


def _change(before: Minimum, minimum: Minimum, rule: StopRule, n_parameters: int) -> float:
    """How far a reweighting moved the log-moduli, or widened what is known of them, over its tolerance."""
    tolerance = rule.tolerance(minimum, n_parameters)
    moved = np.abs(minimum.unknowns - before.unknowns)[:n_parameters] / tolerance
    widened = np.abs(np.log(posterior_sd(minimum, n_parameters) / posterior_sd(before, n_parameters))) / WIDTH
    return float(np.max([moved, np.where(tolerance > rule.floor, widened, 0.0)], initial=0.0))


def _agreed(
    objective: Objective, minimum: Minimum, near: Bounds, bounds: Bounds, rule: StopRule, forcing: float
) -> tuple[Objective, Minimum, float]:
    """Weights and an estimate that agree with each other on the residuals linear around `minimum`; their last change.

    First the estimate under the present weights: what an updated model misses elsewhere would pass for noise. `near`:
    how far the approximations reach within the `bounds`.
    """
    n = objective.n_parameters
    linearised = LinearisedObjective(objective, minimum.unknowns, minimum.evaluation)
    within = forcing * rule.tolerance(minimum, n) / INNER
    found = gauss_newton(linearised, minimum.unknowns, bounds=near, tolerance=LINEARISED, within=within)
    if _cut_short(found, near, bounds):
        return objective, found, np.inf
    for _ in range(rule.passes):
        linearised = replace(linearised, objective=reweighted(linearised.objective, found))
        before = found
        found = gauss_newton(linearised, before.unknowns, bounds=near, tolerance=LINEARISED, within=within)
        change = _change(before, found, rule, n)
        if change < AGREED * min(forcing, FIRST):
            break
    return linearised.objective, found, change


def _cut_short(minimum: Minimum, near: Bounds, bounds: Bounds) -> bool:
    """Whether the reach of the approximations, and no bound of the search, holds a log-modulus back."""
    theta = minimum.unknowns[: len(near.lower)]
    low, high = (theta <= near.lower) & (near.lower > bounds.lower), (theta >= near.upper) & (near.upper < bounds.upper)
    return bool(np.any(low | high))


def _advanced(
    objective: Objective, minimum: Minimum, aim: NDArray[np.float64], settings: InversionSettings
) -> tuple[Objective, Minimum]:
    """The objective matched, and evaluated, at the first of step, step / 2, ... towards `aim` that lowers it.

    Where none does the estimate ends there if the step is within the noise of closest points, else it is `STUCK`.
    """
    n, before, step = objective.n_parameters, minimum.unknowns, aim - minimum.unknowns
    here = LinearisedObjective(objective, before, minimum.evaluation)(before)
    for halving in range(HALVINGS + 1):
        unknowns = before + 0.5**halving * step
        matched = objective.rematched(unknowns)
        there = matched(unknowns)
        if _lowers(here, there, unknowns - before):
            outcome = Outcome.CONVERGED
            break
    else:
        width = np.sqrt(np.diag(there.covariance_columns(n)))
        outcome = Outcome.STALLED if np.all(np.abs(step[:n]) < WITHIN_NOISE * width) else Outcome.STUCK
    arrived = Iterate(unknowns[:n], there.value, there.misfit_mm2, newton_decrement(there))
    found = Minimum(unknowns, there, outcome, (arrived,), halving + 1).after(minimum)
    if settings.method == "lbfgs":
        return matched, minimised(matched, unknowns, settings, within=0.0).after(found)
    return matched, found


def _line_search(now: OuterIterate, there: OuterIterate, worth: Derivatives) -> OuterIterate:
    """The first of step, step / 2, step / 4 ... that lowers the objective on the full model, updated there.

    Where none does the iterate stays: `STALLED` when the step is within the tolerance, else `STUCK`. Raises
    `NotConverged` when the last of them has no equilibrium.
    """
    before = now.minimum.unknowns
    here = LinearisedObjective(there.objective, before, now.minimum.evaluation)(before)
    step, evaluations, failure = there.minimum.unknowns - before, 0, None
    for halving in range(HALVINGS + 1):
        unknowns = before + 0.5**halving * step
        try:
            trial = there.objective.under(_solved(there.objective, unknowns, there.minimum.evaluation, worth))
        except NotConverged as error:
            failure = error
            continue
        evaluation, evaluations, failure = trial(unknowns), evaluations + 1, None
        if _lowers(here, evaluation, unknowns - before):
            spent = there.minimum.evaluations + evaluations
            reached = replace(there.minimum, unknowns=unknowns, evaluation=evaluation, evaluations=spent)
            return replace(there, objective=trial, minimum=reached)
    if failure is not None:
        raise failure
    outcome = Outcome.STALLED if there.step < 1.0 else Outcome.STUCK
    spent = there.minimum.evaluations + evaluations
    stayed = replace(there.minimum, unknowns=before, evaluation=here, outcome=outcome, evaluations=spent)
    return replace(there, minimum=stayed, stayed=True)


def _lowers(now: Evaluation, there: Evaluation, step: NDArray[np.float64]) -> bool:
    """Whether the objective is lower after a step (n_unknowns,).

    By its value, or by the work of its score along the way (the trapezoidal rule, 1/2 (s_0 + s_1) . step): the value
    has the noise of closest points that slide over voxels, the score has not.
    """
    return bool(there.value < now.value + ROUGHNESS or 0.5 * (there.score + now.score) @ step < 0.0)


def _linearisation(objective: Objective, there: Minimum) -> NDArray[np.float64]:
    """How far (n_parameters,), of ln E, derivatives that are exact elsewhere may set an estimate off.

    At a distance d of ln E they are off by a share d, and so is what the residuals pull with them, which is worth a
    posterior standard deviation: d sd, d the largest of all log-moduli; infinite where they are exact nowhere yet. A
    standard deviation counts as 0.03 at least: its own error is a share d, too, and may be a per cent.
    """
    moduli, distance = objective.parameters.moduli(there.unknowns), 0.0
    for approximation in objective.approximations:
        exact = approximation.derivatives_at
        distance = np.inf if exact is None else max(distance, float(np.abs(np.log(moduli / exact)).max()))
    return distance * np.maximum(posterior_sd(there, objective.n_parameters), LEAST_SD)


def _with_approximations(now: OuterIterate, approximations: list[Approximation]) -> OuterIterate:
    """The iterate evaluated on other approximations."""
    objective = now.objective.under(approximations)
    evaluation, spent = objective(now.minimum.unknowns), now.minimum.evaluations + 1
    return replace(now, objective=objective, minimum=replace(now.minimum, evaluation=evaluation, evaluations=spent))


def _solved(
    objective: Objective,
    unknowns: NDArray[np.float64],
    evaluation: Evaluation | None = None,
    worth: Derivatives = Derivatives.KEPT,
) -> list[Approximation]:
    """The states' approximations updated at unknowns, with the derivatives that decide by an evaluation."""
    places = objective.places(unknowns, evaluation, worth)
    return [approximation.update(at) for approximation, at in zip(objective.approximations, places, strict=True)]


def _model_error(objective: Objective, minimum: Minimum) -> tuple[float, NDArray[np.float64], SolveCounts]:
    """What the approximations miss at a minimum: the largest error in energy, and what it cost to know.

    Between them by how much it sets the log-moduli off (n_parameters,): |H^-1 J^T W S du|, with the displacement du
    that is missing, the residuals' smooth derivatives S by it and the Gauss-Newton matrix H = J^T W J + P; infinite
    where an approximation cannot say.
    """
    pairs = list(zip(objective.approximations, objective.places(minimum.unknowns), strict=True))
    cost = sum((approximation.error_counts for approximation, _ in pairs), SolveCounts())
    errors = [approximation.error(at) for approximation, at in pairs]
    largest = max(error.relative for error in errors)
    if not np.isfinite(largest):
        return np.inf, np.full(objective.n_parameters, np.inf), cost
    pull = np.zeros(len(minimum.unknowns))
    for line in minimum.evaluation.lines:
        du = seen_by(line.observation, errors[line.state].missing)
        missing = np.asarray(line.residuals.smooth_jacobian @ du)
        pull[line.columns] += line.jacobian.transposed_times(line.precision * line.weights * missing)
    off = np.abs(minimum.evaluation.covariance_columns(objective.n_parameters).T @ pull)
    return largest, np.asarray(off), cost
