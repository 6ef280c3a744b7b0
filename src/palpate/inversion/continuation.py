"""From minima near which starts lead to their ends: under the law of the case, and with blocks free that were fixed."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

from palpate.approximation.expansion import coarse_equilibrium, expansion_around
from palpate.errors import EstimationError, NotConverged
from palpate.inversion.later_state import LaterState
from palpate.inversion.objective import AS_GOOD, Objective
from palpate.inversion.optimise import Bounds, Minimum, Outcome
from palpate.inversion.trust_region import (
    NEAR,
    OuterIterate,
    StopRule,
    begun,
    minimised,
    predicted,
    total_counted_as,
)
from palpate.mechanics.finite_strain import FiniteStrainEquilibrium
from palpate.progress import Progress

RELEASED = replace(NEAR, all_material=False)  # the deciding directions are enough to judge whether layers are seen
EQUILIBRIUM = 1e-5  # relative residual of the forces while the estimate still moves


@dataclass(frozen=True, slots=True)
class Candidate:
    """A minimum as it ended; `value`: J there, of several by the same numbers of independent residuals.

    released: the same followed on with those blocks free that are fixed while it is sought (see `Block.released`); None
    where there are none, or where it has them free itself. unsettled: why that did not end, "" where it did.
    """

    iterate: OuterIterate
    value: float
    released: OuterIterate | None = None
    unsettled: str = ""

    @property
    def minimum(self) -> Minimum:
        """The minimum under its own objective."""
        return self.iterate.minimum

    @property
    def last(self) -> OuterIterate:
        """What was followed last, with the history, evaluations and counts of all."""
        return self.released or self.iterate


def continued(
    minima: Sequence[OuterIterate], bounds: Bounds, *, rule: StopRule, progress: Progress
) -> tuple[Candidate, ...]:
    """Linear minima, the best one foremost, followed until they end (see `ended`).

    The best one is followed always. Others that converged are where they are as good, or the law is another one; one
    that cannot be followed says so in its outcome. rule: when each ends. Raises what ends the best one: `NotConverged`
    where its equilibrium is not found, with the element and the share of the motion where it ended.
    """
    ends, finite = list[Candidate](), minima[0].objective.states[0].finite_strain is not None
    for near in minima:
        ends.append(Candidate(near, near.objective.total(near.minimum.evaluation)))
        if len(ends) > 1 and not (near.minimum.converged and (finite or ends[-1].value - ends[0].value < AS_GOOD)):
            continue
        try:
            ends[-1] = ended(near, bounds, rule=rule, progress=progress)
        except EstimationError as error:
            if len(ends) == 1:
                raise
            progress(f"another minimum is left out: {error}")
            outcome = Outcome.NO_EQUILIBRIUM if isinstance(error, NotConverged) else Outcome.NOT_FOLLOWED
            ends[-1] = replace(ends[-1], iterate=replace(near, minimum=replace(near.minimum, outcome=outcome)))
    return tuple(ends)


def ended(near: OuterIterate, bounds: Bounds, *, rule: StopRule, progress: Progress) -> Candidate:
    """A linear minimum followed until it ends by the `rule`, under the law of its states and with those blocks free.

    First with the blocks fixed that are while an estimate is sought (see `Block.released`), then with them free. Where
    J, by the same numbers of independent residuals, is then less by more than what is as good, the images tell of what
    was fixed, and this is the candidate. Where it does not end the candidate says why. Raises as `continued` does.
    """
    finite = near.objective.states[0].finite_strain is not None
    if finite:
        before = at_finite_strain(near, bounds, rule=rule, progress=progress)
    else:
        before = minimised(near, bounds, rule, progress=progress, title="linear law")
    fixed, free = Candidate(before, before.objective.total(before.minimum.evaluation)), None
    causes = dict.fromkeys(block.cause for block in before.objective.parameters.blocks if block.released)
    if not before.minimum.converged or not causes:
        return fixed
    try:
        title = f"with {' and '.join(causes)} free"
        end = free = minimised(predicted(before, bounds), bounds, RELEASED, progress=progress, title=title)
        likelier = free.minimum.converged and fixed.value - total_counted_as(free, before) > AS_GOOD
        if likelier:
            end = minimised(free, bounds, rule, progress=progress, title=title)
            end = end.at_equilibrium() if finite else end
    except EstimationError as error:
        return replace(fixed, released=free, unsettled=str(error))
    if not end.minimum.converged:
        return replace(fixed, released=free, unsettled=end.minimum.outcome.value)
    return Candidate(end, end.objective.total(end.minimum.evaluation)) if likelier else replace(fixed, released=free)


def at_finite_strain(near: OuterIterate, bounds: Bounds, *, rule: StopRule, progress: Progress) -> OuterIterate:
    """A linear minimum followed until it ends under the law of its states' `finite_strain` models, at an equilibrium.

    History, evaluations and counts are added to those of `near`. Raises as `continued` does.
    """
    progress("finite strain: the equilibrium at the linear estimate")
    objective, coarse = _coarse(near)
    first = [expansion_around(each, tolerance=EQUILIBRIUM, progress=progress) for each in coarse]
    at = near.minimum
    begin = begun(objective.under(first), at.unknowns, history=at.history, evaluations=at.evaluations)
    start = [replace(begin, checks=near.counts)]
    del coarse, first, begin, objective  # large, and no longer needed
    end = minimised(start.pop(), bounds, rule, progress=progress, title="finite strain")
    progress("finite strain: the exact equilibrium at the estimate")
    return end.at_equilibrium()


def _coarse(linear: OuterIterate) -> tuple[Objective, list[FiniteStrainEquilibrium]]:
    """The objective of a linear minimum without approximations, and the coarse equilibrium of every state there.

    Far from the minimum its states follow the linear law's reduced basis.
    """
    before, points = linear.objective, linear.objective.linearisation_points(linear.minimum.unknowns)
    found, states = list[FiniteStrainEquilibrium](), list[LaterState]()
    for state, basis, point in zip(before.states, before.approximations, points, strict=True):
        assert state.finite_strain is not None
        found.append(coarse_equilibrium(state.finite_strain, basis, point))
        states.append(replace(state, approximation=None, bending=basis))
    return replace(before, states=tuple(states)), found
