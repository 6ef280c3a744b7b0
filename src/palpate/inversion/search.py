"""The search for the posterior: make the models exact, compare all explanations, go where they lead, repeat.

It is the same for the linear and for a finite-strain law, and for every approximation of the model.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from palpate.approximation.contract import updated
from palpate.approximation.expansion import Expansion
from palpate.errors import EstimationError, NotConverged, SolverError
from palpate.inversion.frozen_posterior import Posterior, cheapest_posterior
from palpate.inversion.hyper_parameters import with_amplitudes, with_correlations, with_scales
from palpate.inversion.mixture import MOST, Mixture, mixture_of
from palpate.inversion.objective import Evaluation, LinearisedObjective, Objective
from palpate.inversion.optimise import Bounds, Iterate, Minimum, Outcome, gauss_newton
from palpate.mechanics.equilibrium import ACCURACY
from palpate.mechanics.forward import SolveCounts
from palpate.progress import Progress

RADIUS = 1.5  # of ln E: longest step
FITS, FAR_FITS, STAYS = 10, 2, 0.01  # of the noise near the end, and far from it; change of its ln that ends them
FAR_MOST = 6  # explanations that are compared far from the end
NEAR = 1e-3  # decrement of a minimum on linear residuals
HALVINGS = 5  # of a step that leads to a state which cannot be solved
FLOOR = 1e-4  # of ln E: a move that is always short enough
LAST_FIT = 0.3  # standard deviations that the mean moved: so near, the noise is fitted for the last time
PATIENCE = 3  # iterations after which it is where a step was no longer than one: a search may go to and fro by more
CIRCLE = 0.5  # standard deviations that the mean may move by where a search that went round in circles ends
MEMORY, DEPENDENT = 2, 1e-2  # earlier iterations that count; relative size of ways that count as dependent
CALM = 0.8  # of ln of what residuals weigh: a change with which the noise still follows the search


@dataclass(frozen=True, slots=True)
class StopRule:
    """When a search ends: where the posterior's mean moves by less than so many standard deviations of its own.

    iterations: the largest number.
    """

    step_sd: float = 0.05
    iterations: int = 25


REPORTED = StopRule()  # of an estimate
ROUGH = StopRule(step_sd=0.3)  # of a search that goes on under another law


@dataclass(frozen=True, slots=True)
class Searched:
    """Where a search is: the objective, all unknowns with their evaluation, and the posterior as it is known there.

    The unknowns are the mean of the posterior; where it ends, all but the moduli are at their best under the likeliest
    explanation, under which the evaluation is. mixture: None before the first iteration. settled: whether
    the noise is fitted, after which the objective stays as it is; fits, stayed: number of all iterations, and of those
    since. moved: by how many of its standard deviations the mean moved last; led: theta (n_parameters,) of the last
    iterations near by, and the mean (n_parameters,) found from each.
    """

    objective: Objective
    minimum: Minimum
    mixture: Mixture | None = None
    settled: bool = False
    fits: int = 0
    stayed: int = 0
    moved: float = np.inf
    led: tuple[tuple[NDArray[np.float64], NDArray[np.float64]], ...] = ()

    @property
    def posterior(self) -> Mixture:
        """The mixture. Raises `EstimationError` before the first iteration."""
        if self.mixture is None:
            raise EstimationError("no posterior is known before the first iteration of the search")
        return self.mixture

    @property
    def counts(self) -> SolveCounts:
        """What the full models have cost."""
        return sum((approximation.counts for approximation in self.objective.approximations), SolveCounts())

    def cheapest(self) -> Posterior:
        """The objective with the closest points and weights of the evaluation."""
        return cheapest_posterior(self.objective, self.minimum.unknowns, self.minimum.evaluation)

    def at_equilibrium(self) -> Searched:
        """The same at exact equilibria of its expansions."""
        exact, at = list[Expansion](), self.minimum
        points = self.objective.linearisation_points(at.unknowns)
        for approximation, point in zip(self.objective.approximations, points, strict=True):
            assert isinstance(approximation, Expansion)
            exact.append(approximation.at_equilibrium(point, tolerance=ACCURACY))
        objective = self.objective.under(exact)
        minimum = replace(at, evaluation=objective(at.unknowns), evaluations=at.evaluations + 1)
        return replace(self, objective=objective, minimum=minimum)


def begun(
    objective: Objective, unknowns: NDArray[np.float64], *, history: tuple[Iterate, ...] = (), evaluations: int = 0
) -> Searched:
    """Where a search begins: an objective matched, and evaluated, at unknowns (n_unknowns,).

    history, evaluations: the way there, and what it cost.
    """
    objective = objective.rematched(unknowns)
    evaluation = objective(unknowns)
    history = (*history, Iterate.of(unknowns, evaluation, objective.n_parameters))
    return Searched(objective, Minimum(unknowns, evaluation, Outcome.STEPS, history, evaluations + 1))


def searched(
    begin: Searched,
    bounds: Bounds,
    rule: StopRule,
    *,
    progress: Progress,
    title: str,
    begins: Sequence[NDArray[np.float64]] = (),
) -> Searched:
    """The search followed from where it has `begun` until the posterior's mean moves no more by the `rule`.

    The noise is fitted anew until steps are short, or a search goes to and fro: fitted further away, it has
    correlations of what is still motion. Then it stays, and so does the objective. begins (n_unknowns,) each: where
    further minima are sought. One that goes round in circles goes a share of the way that falls, and ends in their
    middle; it says so in its minimum's outcome, as one that does not end by its rule does. Raises
    `EstimationError`s of models that cannot be solved.
    """
    now = begin if begin.mixture else _with_noise(begin)
    for number in range(1, rule.iterations + 1):
        progress(f"{title}, iteration {number}: {now.objective.parameters.in_words(now.minimum.unknowns)}")
        now = _iteration(now, bounds, rule, begins)
        if now.minimum.outcome is not Outcome.STEPS:
            break
    return now


def _with_noise(begin: Searched) -> Searched:
    """The same with the noise and amplitudes that the residuals there show, all but the moduli at their best."""
    at, n = begin.minimum, begin.objective.n_parameters
    held = Bounds(at.unknowns[:n], at.unknowns[:n])
    objective, _ = _fitted(begin, held, fits=True)
    linear = LinearisedObjective(objective, at.unknowns, at.evaluation)
    unknowns = gauss_newton(linear, at.unknowns, bounds=held, tolerance=NEAR).unknowns
    objective = objective.rematched(unknowns)
    there = replace(at, unknowns=unknowns, evaluation=objective(unknowns), evaluations=at.evaluations + 1)
    return replace(begin, objective=objective, minimum=there)


def _iteration(now: Searched, bounds: Bounds, rule: StopRule, begins: Sequence[NDArray[np.float64]]) -> Searched:
    """The posterior with the models exact where the search is, and the search where its mean leads."""
    n, at = now.objective.n_parameters, now.minimum
    theta = at.unknowns[:n]
    radius = min([RADIUS, *(approximation.trust_radius for approximation in now.objective.approximations)])
    near = bounds.around(theta, radius)
    objective, evaluation = _fitted(now, near, fits=not now.settled)
    posterior = cheapest_posterior(objective, at.unknowns, evaluation)
    exact = now.moved < 1.0
    mixture = mixture_of(
        posterior,
        at.unknowns,
        evaluation,
        near,
        begins=begins,
        most=MOST if now.moved < 1.0 else FAR_MOST,
        earlier=now.mixture,
        narrowest=now.mixture is None,  # responses to patches are those of moduli that nothing speaks for
    )
    objective = objective.believing(mixture.explanations[0].prior(objective.parameters))
    sd = np.maximum(mixture.sd, FLOOR / rule.step_sd)
    moved = float(np.max(np.abs(mixture.mean - theta) / sd, initial=0.0))
    share = 1.0 / max(now.stayed - PATIENCE, 1)  # evidence that changes with the place leads round in circles else
    near_end = now.moved < LAST_FIT or (exact and now.fits >= PATIENCE)
    settled = now.settled or (near_end and _change(now.objective, objective) < CALM)
    before = replace(
        now,
        objective=objective,
        mixture=mixture,
        moved=moved,
        settled=settled,
        fits=now.fits + 1,
        stayed=now.stayed + settled,
    )
    stays, circles = moved < rule.step_sd, share * moved < rule.step_sd and moved < CIRCLE
    if (settled if rule.step_sd < LAST_FIT else exact) and (stays or circles):
        evaluation, outcome = evaluation.under(objective.parameters, at.unknowns), Outcome.CIRCLED
        minimum = replace(at, evaluation=evaluation, outcome=Outcome.CONVERGED if stays else outcome)
        return _as_likeliest(replace(before, minimum=minimum, settled=True), posterior)
    led = (*(now.led[-MEMORY:] if exact else ()), (theta, mixture.mean))
    goal = _fixed_point(led, sd) if share == 1.0 else theta + share * (mixture.mean - theta)
    target = np.concatenate([np.clip(goal, near.lower, near.upper), mixture.mean_unknowns[n:]])
    return _taken(replace(before, led=led), evaluation, target)


def _change(before: Objective, objective: Objective) -> float:
    """Largest change of ln of what a residual of any observation weighs."""
    was, now = (np.log([o.weighting.precision for o in of.observations]) for of in (before, objective))
    return float(np.abs(now - was).max(initial=0.0))


def _fixed_point(
    led: Sequence[tuple[NDArray[np.float64], NDArray[np.float64]]], sd: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Theta (n_parameters,) from which the mean should lead nowhere, by where the last iterations led.

    Anderson's acceleration (Walker & Ni, SIAM J. Numer. Anal. 49 (2011) 1715) in standard deviations (n_parameters,):
    without it a search goes to and fro where the responses to patchy tissues depend much on the moduli.
    """
    scale = np.where(np.isfinite(sd), sd, 1.0)  # a modulus that moves nothing has none
    places, means = (np.stack(each) / scale for each in zip(*led, strict=True))
    ways = means - places
    if len(led) == 1:
        return np.asarray(means[-1] * scale)
    by_places, by_ways = np.diff(places, axis=0).T, np.diff(ways, axis=0).T
    shares = np.linalg.lstsq(by_ways, ways[-1], rcond=DEPENDENT)[0]
    return np.asarray((means[-1] - (by_places + by_ways) @ shares) * scale)


def _fitted(now: Searched, near: Bounds, *, fits: bool) -> tuple[Objective, Evaluation]:
    """The objective with the noise that the residuals show if it `fits`, and the evaluation with robust weights there.

    Both by the minimum on residuals that are linear around where the search is, under the present explanation.
    """
    at, objective = now.minimum, now.objective
    number = FITS if now.moved < 1.0 else FAR_FITS
    for _ in range(number if fits else 1):
        linear = LinearisedObjective(objective, at.unknowns, at.evaluation)
        found = gauss_newton(linear, at.unknowns, bounds=near, tolerance=NEAR)
        if not fits:
            break
        before, objective = objective, with_scales(with_correlations(objective, found.evaluation), found.evaluation)
        if _change(before, objective) < STAYS:
            break
    if fits:
        here = LinearisedObjective(objective, at.unknowns, at.evaluation)(found.unknowns)
        objective = with_amplitudes(objective, here, found.unknowns)
    like = LinearisedObjective(objective, at.unknowns, at.evaluation)(found.unknowns).linearisations
    return objective, objective.weighed(at.unknowns, at.evaluation.linearisations, like)


def _as_likeliest(end: Searched, posterior: Posterior) -> Searched:
    """The search where it ends, all unknowns but the moduli at their best under the likeliest explanation."""
    at, objective = end.minimum, end.objective
    theta = at.unknowns[: objective.n_parameters]
    start = np.concatenate([theta, end.posterior.minimum.unknowns[len(theta) :]])
    target = gauss_newton(posterior.believing(objective.parameters), start, bounds=Bounds(theta, theta), tolerance=NEAR)
    there = _taken(end, at.evaluation, target.unknowns)
    history = (*at.history[:-1], there.minimum.history[-1])
    return replace(there, minimum=replace(there.minimum, outcome=at.outcome, history=history))


def _taken(now: Searched, evaluation: Evaluation, target: NDArray[np.float64]) -> Searched:
    """The search at a target (n_unknowns,), or nearer where its state cannot be solved."""
    at, objective, failure = now.minimum, now.objective, SolverError("no step was tried")
    believed = evaluation.under(objective.parameters, at.unknowns)
    for _ in range(HALVINGS):
        try:
            there = _exact(objective, believed, target, near=now.settled or now.moved < 1.0)
        except (NotConverged, SolverError) as error:
            failure, target = error, at.unknowns + 0.5 * (target - at.unknowns)
            continue
        reached = there(target)
        history = (*at.history, Iterate.of(target, reached, objective.n_parameters))
        minimum = Minimum(target, reached, Outcome.STEPS, history, at.evaluations + 1)
        return replace(now, objective=there, minimum=minimum)
    raise failure


def _exact(objective: Objective, evaluation: Evaluation, unknowns: NDArray[np.float64], *, near: bool) -> Objective:
    """The objective matched at unknowns (n_unknowns,), its models exact there along the directions that decide.

    These are those of the evaluation nearby, under the likeliest explanation and with the widest tissues. near: whether
    the end is so near that derivatives by all material modes are made exact, too.
    """
    wide = dict[int, int]()
    for i, block in enumerate(objective.parameters.blocks):
        if block.choice.of_tissues:
            wide[i] = len(block.alternatives) - 1
    other = evaluation.under(objective.parameters.choosing(wide), unknowns)
    both = [evaluation, other] if wide else [evaluation]
    points = objective.linearisation_points(unknowns, both, all_material=near)
    return objective.under(updated(objective.approximations, points)).rematched(unknowns)
