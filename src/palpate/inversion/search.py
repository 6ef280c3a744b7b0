"""The search for the posterior: make the models exact, compare all explanations, go where they lead, repeat.

It is the same for the linear and for a finite-strain law, and for every approximation of the model.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from palpate.approximation.contract import updated
from palpate.approximation.expansion import Expansion
from palpate.errors import EstimationError, NotConverged, SolverError
from palpate.inversion.frozen_posterior import Posterior, cheapest_posterior
from palpate.inversion.hyper_parameters import with_amplitudes, with_correlations, with_scales
from palpate.inversion.laplace import MarginalMinimum, MarginalPosterior
from palpate.inversion.linear_evidence import Candidates
from palpate.inversion.mixture import Mixture, mixture_of
from palpate.inversion.objective import Evaluation, LinearisedObjective, Objective
from palpate.inversion.optimise import Bounds, Iterate, Minimum, Outcome, gauss_newton, same_minimum
from palpate.inversion.scenarios import Alternatives, scenarios_of
from palpate.mechanics.equilibrium import ACCURACY
from palpate.mechanics.forward import SolveCounts
from palpate.parallel import mapped
from palpate.progress import Progress
from palpate.unknowns.blocks import Choice

RADIUS = 1.5  # of ln E: longest step
FITS, FAR_FITS, STAYS = 10, 2, 0.01  # of the noise near the end, and far from it; change of its ln that ends them
NEAR = 1e-3  # decrement of a minimum on linear residuals
NEAR_FOR_NOISE = 0.1  # the same of one whose residuals tell the noise alone
HALVINGS = 5  # of a step that leads to a state which cannot be solved
FLOOR = 1e-4  # of ln E: a move that is always short enough
LAST_FIT = 0.3  # standard deviations that the mean moved: so near, the noise is fitted for the last time
PATIENCE = 3  # iterations after which it is where a step was no longer than one: a search may go to and fro by more
CALM = 0.8  # of ln of what residuals weigh: a change with which the noise still follows the search
FREE = 2, 4  # first iterations, at least and at most, of homogeneous tissues, in which the frame may move or not
FAR_MOST, OF_RIVALS = 4, 2  # explanations that are compared on the way; those of each other group
FAR_PLACES = 3  # far from its end, or of a rival, of the search for the minimum of an explanation
RIVAL = 3.0  # of the log-evidence: groups less likely by so much, as the likeliest one sees them, are left out
FOLLOWED = 4  # iterations in which a rival is followed
CHANGES = 2  # of the likeliest group, after which the search ends


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
    explanation, under which the evaluation is. mixture: None before the first iteration; group: of the explanations
    that it follows, None at first; settled: whether the noise is fitted, after which the objective stays as it is;
    fits: number of iterations; moved: by how many of its standard deviations the mean moved last; frozen: the posterior
    with the closest points and weights where the mixture is of.
    """

    objective: Objective
    minimum: Minimum
    mixture: Mixture | None = None
    group: tuple[str, ...] | None = None
    settled: bool = False
    fits: int = 0
    moved: float = np.inf
    frozen: Posterior | None = None

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
        objective = self.objective.with_approximations(exact)
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

    The likeliest group of explanations is followed to its best. There all others are compared, and those that may be
    likely are followed to their own best, under the same noise: models and closest points at the best of one make
    another look likelier than it is. One that is likelier indeed takes its place. The noise is fitted anew until steps
    are short: fitted further away, it has correlations of what is still motion. begins (n_unknowns,) each: where
    further minima are sought. One that does not end by its rule says so in its minimum's outcome. Raises
    `EstimationError`s of models that cannot be solved.
    """
    now = begin if begin.mixture else _with_noise(begin)
    for change in range(CHANGES + 1):
        now = _followed(now, bounds, rule, progress=progress, title=title, begins=begins)
        if not now.minimum.converged:
            return now
        best, every = now, [now.posterior]
        for rival in _rivals(now, bounds):
            words = f"{title}, {', '.join(word for word in rival.group or () if word)}"
            few, least = replace(rule, iterations=FOLLOWED), now.posterior.level - RIVAL
            found = _followed(rival, bounds, few, progress=progress, title=words, least=least)
            every.append(found.posterior)
            best = max(best, found, key=lambda each: each.posterior.level)
            if best is not now and change < CHANGES:
                break  # the others are compared again from there
        if best is now or change == CHANGES:
            break
        now = replace(best, settled=False, fits=0, minimum=replace(best.minimum, outcome=Outcome.STEPS))
    end = best if best.minimum.converged else now
    return _ended(end, Mixture.of(of for each in every for of in each.explanations), bounds)


def approached(begin: Searched, bounds: Bounds, *, progress: Progress, title: str) -> Searched:
    """Where the first iterations of a search lead from where it has `begun`: near its end, and no further."""
    now = _with_noise(begin)
    for number in range(1, FREE[1] + 1):
        progress(f"{title}, iteration {number}: {now.objective.parameters.in_words(now.minimum.unknowns)}")
        now = _iteration(now, bounds, ROUGH, ())
        if now.moved < ROUGH.step_sd:
            break
    return now


def _followed(
    now: Searched,
    bounds: Bounds,
    rule: StopRule,
    *,
    progress: Progress,
    title: str,
    begins: Sequence[NDArray[np.float64]] = (),
    least: float = -np.inf,
) -> Searched:
    """The search within one group of explanations, followed until its mean moves no more by the `rule`.

    least: level below which it is too unlikely to be followed.
    """
    for number in range(1, rule.iterations + 1):
        progress(f"{title}, iteration {number}: {now.objective.parameters.in_words(now.minimum.unknowns)}")
        now = _iteration(now, bounds, rule, begins)
        if now.minimum.outcome is not Outcome.STEPS or now.posterior.level < least:
            break
    return now


def _rivals(now: Searched, bounds: Bounds) -> Iterator[Searched]:
    """Where other groups of explanations are followed, those that may be likely as they are seen from its best.

    One after the other: each has the derivatives of all residuals there.
    """
    assert now.frozen is not None, "a search has come to its end"
    at, n = now.minimum, now.objective.n_parameters
    near = bounds.around(at.unknowns[:n], RADIUS)

    def kept(scenario: Alternatives) -> bool:
        """Those of other groups."""
        return scenario.group != now.group

    if not any(map(kept, scenarios_of(now.frozen.parameters.blocks))):
        return
    some = Candidates(kept, of_group=OF_RIVALS, places=FAR_PLACES)
    seen = mixture_of(now.frozen, at.unknowns, at.evaluation, near, some)
    found = set[tuple[str, ...]]()
    for of in seen.explanations:
        if of.level > now.posterior.level - RIVAL and of.group not in found:
            found.add(of.group)
            own = Mixture(tuple(other for other in seen.explanations if other.group == of.group))
            objective = now.objective.with_prior(of.prior(now.objective.parameters))
            before = replace(now, objective=objective, mixture=own, group=of.group, moved=np.inf)
            yield _taken(before, at.evaluation, of.minimum.unknowns)


def likely_minima(now: Searched, begins: Sequence[NDArray[np.float64]], bounds: Bounds) -> list[NDArray[np.float64]]:
    """Further minima (n_unknowns,) of the likeliest explanation that may be likely, each sought from one of `begins`.

    As they are seen from where a search has ended; the others would cost as much as a search.
    """
    if now.frozen is None or not begins:
        return []
    n, likeliest = now.objective.n_parameters, now.posterior.explanations[0]
    own = MarginalPosterior.of(now.frozen.with_prior(likeliest.prior(now.frozen.parameters)))

    def of(begin: NDArray[np.float64]) -> MarginalMinimum | None:
        """That which is found from there; None where the model cannot be solved."""
        try:
            return own.minimum(begin, bounds)
        except SolverError:
            return None

    least, *found = mapped(of, [likeliest.minimum.unknowns, *begins])
    assert least is not None, "the model was solved where the search ended"
    likely = [each.minimum for each in found if each is not None and each.value < least.value + RIVAL]
    return [each.unknowns for each in likely if not same_minimum(each.unknowns, least.minimum, n)]


def _ended(now: Searched, mixture: Mixture, bounds: Bounds) -> Searched:
    """The search where it ends: at the mean of the mixture, all else at its best under the likeliest explanation."""
    at, objective = now.minimum, now.objective
    assert now.frozen is not None, "a search has come to its end"
    objective = objective.with_prior(mixture.explanations[0].prior(objective.parameters))
    theta = np.clip(mixture.mean, bounds.lower, bounds.upper)
    start = np.concatenate([theta, mixture.minimum.unknowns[len(theta) :]])
    own, held = now.frozen.with_prior(objective.parameters), Bounds(theta, theta)
    target = gauss_newton(own, start, bounds=held, tolerance=NEAR).unknowns
    there = _taken(replace(now, objective=objective, mixture=mixture), at.evaluation, target)
    before = at.history[:-1] if np.array_equal(at.history[-1].theta, theta) else at.history  # no place stands twice
    history = (*before, there.minimum.history[-1])
    return replace(there, minimum=replace(there.minimum, outcome=at.outcome, history=history))


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
    n, at, blocks = now.objective.n_parameters, now.minimum, now.objective.parameters.blocks
    theta = at.unknowns[:n]
    radius = min([RADIUS, *(approximation.trust_radius for approximation in now.objective.approximations)])
    near = bounds.around(theta, radius)
    objective, evaluation = _fitted(now, near, fits=not now.settled)
    posterior = cheapest_posterior(objective, at.unknowns, evaluation)

    def kept(scenario: Alternatives) -> bool:
        """Those of the group; at first of homogeneous tissues: responses to patches are those far away."""
        if now.group is not None:
            return scenario.group == now.group
        return not any(k for i, k in scenario.chosen if blocks[i].choice is Choice.PATCHINESS)

    exact = now.moved < 1.0
    own = Candidates(kept) if exact else Candidates(kept, FAR_MOST, places=FAR_PLACES)
    mixture = mixture_of(posterior, at.unknowns, evaluation, near, own, begins=begins, earlier=now.mixture)
    objective = objective.with_prior(mixture.explanations[0].prior(objective.parameters))
    sd = np.maximum(mixture.sd, FLOOR / rule.step_sd)
    moved = float(np.max(np.abs(mixture.mean - theta) / sd, initial=0.0))
    near_end = now.moved < LAST_FIT or (exact and now.fits >= PATIENCE)
    settled = now.settled or (near_end and now.group is not None and _change(now.objective, objective) < CALM)
    free = now.fits + 1 < FREE[0 if exact else 1]
    group = mixture.explanations[0].group if now.group is None and not free else now.group
    before = replace(
        now,
        objective=objective,
        mixture=mixture,
        group=group,
        moved=moved,
        settled=settled,
        fits=now.fits + 1,
        frozen=posterior,
    )
    if now.group is not None and exact and (settled or rule.step_sd >= LAST_FIT) and moved < rule.step_sd:
        evaluation = evaluation.with_prior(objective.parameters, at.unknowns)
        minimum = replace(at, evaluation=evaluation, outcome=Outcome.CONVERGED)
        return replace(before, minimum=minimum, settled=True)
    target = np.concatenate([np.clip(mixture.mean, near.lower, near.upper), mixture.mean_unknowns[n:]])
    return _taken(before, evaluation, target)


def _change(before: Objective, objective: Objective) -> float:
    """Largest change of ln of what a residual of any observation weighs."""
    was, now = (np.log([o.weighting.precision for o in of.observations]) for of in (before, objective))
    return float(np.abs(now - was).max(initial=0.0))


def _fitted(now: Searched, near: Bounds, *, fits: bool) -> tuple[Objective, Evaluation]:
    """The objective with the noise that the residuals show if it `fits`, and the evaluation with robust weights there.

    Both by the minimum on residuals that are linear around where the search is, under the present explanation.
    """
    at, objective = now.minimum, now.objective
    number, start = FITS if now.moved < 1.0 else FAR_FITS, at.unknowns
    for fit in range(number if fits else 1):
        linear = LinearisedObjective(objective, at.unknowns, at.evaluation)
        found = gauss_newton(linear, start, bounds=near, tolerance=NEAR_FOR_NOISE)
        if not fits:
            break
        before, start = objective, found.unknowns
        objective = objective if fit else with_correlations(objective, found.evaluation)
        objective = with_scales(objective, found.evaluation)
        if _change(before, objective) < STAYS:
            break
    if fits:
        here = LinearisedObjective(objective, at.unknowns, at.evaluation)(found.unknowns)
        objective = with_amplitudes(objective, here, found.unknowns)
    like = LinearisedObjective(objective, at.unknowns, at.evaluation)(found.unknowns).linearisations
    return objective, objective.weighed(at.unknowns, at.evaluation.linearisations, like)


def _taken(now: Searched, evaluation: Evaluation, target: NDArray[np.float64]) -> Searched:
    """The search at a target (n_unknowns,), or nearer where its state cannot be solved."""
    at, objective = now.minimum, now.objective
    failure: EstimationError = SolverError("no step was tried")
    believed = evaluation.with_prior(objective.parameters, at.unknowns)
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
    other = evaluation.with_prior(objective.parameters.choosing(wide), unknowns)
    both = [evaluation, other] if wide else [evaluation]
    points = objective.linearisation_points(unknowns, both, all_material=near)
    return objective.with_approximations(updated(objective.approximations, points)).rematched(unknowns)
