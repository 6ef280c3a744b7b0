"""From starts to the distinct minima that they lead to, and which of them is the best under one objective."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from palpate.inversion.frozen_posterior import cheapest_minima
from palpate.inversion.objective import AS_GOOD, Evaluation, Objective
from palpate.inversion.optimise import Bounds, Minimum, grouped, same_minimum
from palpate.inversion.trust_region import NEAR, Convergence, OuterIterate, StopRule, begun, minimised, with_fewest
from palpate.mechanics.forward import SolveCounts
from palpate.progress import Progress, silent

COMPARED = replace(NEAR, correlate=False)  # the numbers of independent residuals stay: objectives are compared
FOLLOWED = 2  # minima of starts beside the first one, the best


@dataclass(frozen=True, slots=True)
class StartRun:
    """What one start did on the cheapest model: log-moduli (n_parameters,) where it began, and the minimum it found.

    candidate: number of the minimum that it leads to, None where that was not followed, others being lower.
    """

    theta: NDArray[np.float64]
    minimum: Minimum
    candidate: int | None


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

    evaluations, counts: of everything that was followed to find and compare them, not of the best one alone. released:
    the best one followed on with those blocks free that are fixed while it is sought (see `Block.released`); None where
    there are none, or where the best one itself has them free. unsettled: why it did not end, "" where it did.
    """

    candidates: tuple[Candidate, ...]
    best: int
    starts: tuple[StartRun, ...]
    rest: Evaluation
    evaluations: int
    counts: SolveCounts
    released: OuterIterate | None = None
    unsettled: str = ""

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
        """What the best minimum's last outer iteration left unmet."""
        return self.candidates[self.best].iterate.convergence


def from_starts(
    start: OuterIterate,
    starts: Sequence[NDArray[np.float64]],
    bounds: Bounds,
    *,
    rule: StopRule | None,
    progress: Progress,
) -> Inversion:
    """The minima that all starts lead to: each on the cheapest model, the best ones followed on the objective's own.

    start: where the first minimum is sought; starts: theta (n_parameters,) each. rule: when the best one ends, and
    others that are as good; None: all end near, as the start of another law. Raises as `invert` does.
    """
    n, nothing = start.objective.n_parameters, np.zeros(len(start.minimum.unknowns))
    rest = start.objective.rematched(nothing)(nothing)
    first = minimised(start, bounds, NEAR, progress=progress, title="the first minimum")
    progress(f"{len(starts)} starts, with the closest points of the first minimum")
    at = first.minimum
    begins = [np.concatenate([theta, at.unknowns[n:]]) for theta in starts]
    screened = cheapest_minima(first.objective, at.unknowns, at.evaluation, begins, bounds)
    ends, groups = [first], grouped(screened, n)
    belongs = {groups[i]: 0 for i, m in enumerate(screened) if same_minimum(m.unknowns, at, n)}
    for number in sorted(range(len(screened)), key=lambda i: screened[i].evaluation.value):
        if len(ends) <= FOLLOWED and groups[number] not in belongs and screened[number].converged:
            belongs[groups[number]], begin = len(ends), begun(first.objective, screened[number].unknowns)
            ends.append(minimised(begin, bounds, COMPARED, progress=progress, title=f"start {number + 1}"))
    pairs = zip(starts, screened, groups, strict=True)
    runs = [StartRun(theta, minimum, belongs.get(group)) for theta, minimum, group in pairs]
    found = concluded(ends, runs, rest, bounds, 0)
    evaluations = 1 + sum(end.minimum.evaluations for end in ends) + found.evaluations
    counts = sum((end.counts - first.counts for end in ends[1:]), first.counts)
    if rule is not None:
        followed, least = list[OuterIterate](), found.candidates[found.best].value
        for number, candidate in enumerate(found.candidates):
            end = candidate.iterate
            if number == found.best or (candidate.minimum.converged and as_good(candidate.value, least)):
                end = minimised(end, bounds, rule, progress=progress, title="linear law")
            evaluations += end.minimum.evaluations - candidate.minimum.evaluations
            counts += end.counts - candidate.iterate.counts
            followed.append(end)
        found = concluded(followed, found.starts, rest, bounds, found.best)
        evaluations += found.evaluations
    return replace(found, evaluations=evaluations, counts=counts)


def as_good(value: float, best: float, *, scale: float = 1.0) -> bool:
    """Whether a minimum of a `value` of minus the log posterior is as likely as one of `best`, as far as data can say.

    By the rule of a 95 % interval: twice their difference, times a `scale` of the deviance (see `Profile`), is below
    1.96^2. A difference does not depend on how many residuals make it up.
    """
    return scale * (value - best) < AS_GOOD


def concluded(
    followed: Sequence[OuterIterate],
    starts: Sequence[StartRun],
    rest: Evaluation,
    bounds: Bounds,
    first: int,
) -> Inversion:
    """The distinct ones of the iterates, compared with each other; `first`: the number of the one sought first."""
    n = followed[0].objective.n_parameters
    groups = grouped([iterate.minimum for iterate in followed], n)

    def rank(i: int) -> tuple[bool, bool, int]:
        """A minimum is stood for by the one sought first, else by one that converged."""
        return i != first, not followed[i].minimum.converged, i

    of_group = [[i for i, of in enumerate(groups) if of == group] for group in range(max(groups) + 1)]
    distinct = [followed[min(own, key=rank)] for own in of_group]
    values, evaluations = compared(distinct, bounds)
    candidates = tuple(Candidate(iterate, value) for iterate, value in zip(distinct, values, strict=True))
    usable = [c.value if c.minimum.converged else np.inf for c in candidates]
    best = int(np.argmin(usable)) if np.isfinite(usable).any() else groups[first]
    joined = tuple(s if s.candidate is None else replace(s, candidate=groups[s.candidate]) for s in starts)
    return Inversion(candidates, best, joined, rest, evaluations, SolveCounts())


def compared(distinct: Sequence[OuterIterate], bounds: Bounds) -> tuple[list[float], int]:
    """The objective at each iterate, hyper-parameters at their best, and what it cost in evaluations.

    All with the same numbers of independent residuals (see `with_fewest`).
    """
    if len(distinct) == 1:
        return [distinct[0].objective.total(distinct[0].minimum.evaluation)], 0
    reference = with_fewest(distinct).objective
    values, evaluations = [], 0
    for iterate in distinct:
        begin = begun(iterate.objective.counted_as(reference), iterate.minimum.unknowns)
        end = minimised(begin, bounds, COMPARED, progress=silent, title="compared")
        values.append(end.objective.total(end.minimum.evaluation))
        evaluations += end.minimum.evaluations
    return values, evaluations
