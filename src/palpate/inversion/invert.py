"""From models and targets to the moduli that explain the later images: starts, weights, exact models, minima."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from palpate.inversion.agreement import AGREED, PASSES, agreed, left_since
from palpate.inversion.continuation import continued_at_finite_strain
from palpate.inversion.directions import deciding_directions
from palpate.inversion.driver_prior import learned_prior
from palpate.inversion.gauss_newton import Minimum
from palpate.inversion.minima import (
    SETTLED,
    best_of,
    continued,
    driven,
    groups_of,
    minimised,
    moved_between,
    with_driver,
    words,
)
from palpate.inversion.noise import NoiseLaw
from palpate.inversion.objective import Objective
from palpate.inversion.problem import InverseProblem, Inversion, InversionSettings
from palpate.inversion.surrogate import Surrogate, first_surrogate, sharpened, with_modulus_series, with_offset
from palpate.inversion.wall_refinement import REFINEMENTS, refined_walls
from palpate.inversion.weighting import first_law, objective_of
from palpate.mechanics.forward import SolveCounts
from palpate.mechanics.linear_model import with_constraint
from palpate.mechanics.reduced import ReducedModel

__all__ = ["invert", "invert_with"]

ROUNDS = 9
FIRST_STEPS = 2  # of the drivers' motion at a start's moduli, before these move
ROUGH_SURFACE = 1.0 / 3.0  # mm, of a residual; below that a model must be as much more exact


@dataclass(frozen=True, slots=True)
class _Effort:
    """How far an estimate is taken.

    unsolved: relative error in energy of a displacement, below which a round goes without the full model; certified:
    that with which an estimate may end where surfaces are rough; left: what derivatives that are exact elsewhere may
    leave of ln E (see `left_since`); within, passes: to which weights and estimate agree in a round, after so many
    passes at the most; settled: by so many posterior standard deviations a round may still move it; others: decrement
    of the starts that ended elsewhere; refinements: of the drivers' walls, at the most.
    """

    unsolved: float
    certified: float
    left: float
    within: float
    passes: int
    settled: float
    others: float
    refinements: int


TO_REPORT = _Effort(0.0, 2e-4, AGREED, AGREED, PASSES, SETTLED, 1e-4, REFINEMENTS)
TO_START_FROM = _Effort(0.1, np.inf, np.inf, np.inf, 1, 0.5, 1e-3, 0)


@dataclass(frozen=True, slots=True)
class _Place:
    """Where the last round led: a minimum of the objective made of the reduced models.

    settled: whether weights and models would move it by little; final: whether they are exact enough to end there.
    """

    objective: Objective
    minimum: Minimum
    law: NoiseLaw
    surrogates: tuple[Surrogate, ...]
    settled: bool = False
    final: bool = False


def invert(problem: InverseProblem, settings: InversionSettings, *, progress: Callable[[str], None]) -> Inversion:
    """Estimate log-moduli and driver motion together, from all starts, with the linear law first.

    The reduced models are made at the middle start and enriched at the estimate until it no longer moves.
    """
    middle = _middle(settings)
    moduli = problem.modulus_map.moduli(middle)
    progress("responses of the full model at the middle start")
    surrogates = tuple(first_surrogate(model, moduli) for model in problem.models)
    objective = objective_of(problem, _reduced(surrogates), settings.law or first_law(problem))
    still = np.concatenate([middle, np.zeros(objective.n_unknowns - len(middle))])
    filled = driven(objective.with_fresh_correspondence(still), middle, bounds=settings.bounds)
    motions = objective.coefficients(filled.unknowns)
    pairs = zip(surrogates, motions, strict=True)
    surrogates = tuple(with_modulus_series(s, q, problem.modulus_map.columns) for s, q in pairs)
    linear = invert_with(problem, settings, surrogates, progress=progress, motion=np.concatenate(motions))
    if not problem.finite_strain:
        return linear
    return continued_at_finite_strain(problem, linear, settings, progress=progress)


def invert_with(
    problem: InverseProblem,
    settings: InversionSettings,
    surrogates: tuple[Surrogate, ...],
    *,
    progress: Callable[[str], None],
    motion: NDArray[np.float64] | None = None,
) -> Inversion:
    """The linear estimate from reduced models that are already there.

    motion (n_coefficients,): the drivers', where the search begins; None: at rest. Where another law follows, the
    estimate only has to come near: it may still move by half a posterior standard deviation.
    """
    effort = TO_START_FROM if problem.finite_strain else TO_REPORT
    law = settings.law or first_law(problem)
    objective = objective_of(problem, _reduced(surrogates), law)
    still = np.zeros(objective.n_unknowns)
    objective = objective.with_fresh_correspondence(still)
    rest = objective(still)
    filled = driven(objective, _middle(settings), bounds=settings.bounds, coefficients=motion)
    objective = replace(objective, prior=learned_prior(problem, filled.evaluation, filled.unknowns))
    minima = _from_starts(objective, settings, filled.unknowns[objective.n_parameters :], progress)
    chosen = best_of(minima)
    end = _followed(problem, _Place(objective, minima[chosen], law, surrogates), settings, effort, progress)
    minima = _ended(end.objective, settings, minima, end.minimum, chosen, tolerance=effort.others)
    counts = sum((s.counts for s in end.surrogates), SolveCounts())
    return Inversion(
        end.objective,
        minima,
        groups_of(minima, objective.n_parameters),
        best_of(minima),
        end.law,
        end.surrogates,
        rest,
        end.settled,
        evaluations=sum(len(minimum.history) for minimum in minima),
        counts=counts,
    )


def _followed(
    problem: InverseProblem,
    place: _Place,
    settings: InversionSettings,
    effort: _Effort,
    progress: Callable[[str], None],
) -> _Place:
    """Rounds from a minimum until it moves no more, its walls refined where they ask for it."""
    refinements = 0
    for round_ in range(ROUNDS):
        progress(f"round {round_ + 1}: {words(problem, place.minimum)}; the full model is solved there")
        place = _round(problem, place, settings, effort)
        if place.final:
            done = refinements == effort.refinements or round_ == ROUNDS - 1
            finer = place.surrogates if done else _refined(problem, place.surrogates, place.minimum, place.law)
            if all(a is b for a, b in zip(finer, place.surrogates, strict=True)):
                break
            place, refinements = replace(place, surrogates=finer, settled=False, final=False), refinements + 1
    return place


def _round(problem: InverseProblem, place: _Place, settings: InversionSettings, effort: _Effort) -> _Place:
    """The full model at the place, then weights and estimate that agree on what the reduced one has learned there."""
    before, n = place.minimum, place.objective.n_parameters
    surrogates = _enriched(problem, place.surrogates, place.objective, before, unless=effort.unsolved)
    objective = place.objective.under(_reduced(surrogates))
    end = agreed(problem, objective, before, settings, within=effort.within, passes=effort.passes)
    left = left_since(before.unknowns[:n], end.minimum, n)
    agree = end.change < AGREED or end.moved < effort.settled
    settled = agree and (left < AGREED or moved_between(before, end.minimum, n) < effort.settled)
    arrived = _Place(end.objective, end.minimum, end.law, surrogates, settled)
    certified = effort.certified * min(end.law.sd / ROUGH_SURFACE, 1.0)
    return replace(arrived, final=settled and left < effort.left and _relative_error(problem, arrived) < certified)


def _ended(
    objective: Objective,
    settings: InversionSettings,
    minima: tuple[Minimum, ...],
    best: Minimum,
    chosen: int,
    *,
    tolerance: float,
) -> tuple[Minimum, ...]:
    """Where the starts end when the `chosen` one has been followed to `best`: those that had met it go on with it."""
    met, begun = groups_of(minima, objective.n_parameters), len(minima[chosen].history)
    return tuple(
        replace(best, history=m.history + best.history[begun:])
        if group == met[chosen]
        else continued(objective, with_driver(m, best, objective.n_parameters), settings, tolerance=tolerance)
        for m, group in zip(minima, met, strict=True)
    )


def _middle(settings: InversionSettings) -> NDArray[np.float64]:
    """Median (n_parameters,) of the starts' log-moduli."""
    return np.asarray(np.median(np.stack(settings.starts), axis=0))


def _refined(
    problem: InverseProblem, surrogates: tuple[Surrogate, ...], minimum: Minimum, law: NoiseLaw
) -> tuple[Surrogate, ...]:
    """The surrogates with finer motions of the drivers' walls, where their surfaces ask for it."""
    constraints = tuple(surrogate.constraint for surrogate in surrogates)
    finer = refined_walls(problem, constraints, minimum.evaluation.surfaces, law)
    pairs = zip(surrogates, finer, strict=True)
    return tuple(s if c is s.constraint else with_offset(s, with_constraint(s.model, c)) for s, c in pairs)


def _enriched(
    problem: InverseProblem,
    surrogates: tuple[Surrogate, ...],
    objective: Objective,
    minimum: Minimum,
    *,
    unless: float,
) -> tuple[Surrogate, ...]:
    """Solve the full models at a minimum where the reduced ones' relative error is not below `unless`."""
    moduli = problem.modulus_map.moduli(minimum.unknowns[: objective.n_parameters])
    triples = zip(
        surrogates,
        objective.coefficients(minimum.unknowns),
        deciding_directions(objective, minimum.evaluation),
        strict=True,
    )
    return tuple(s if s.relative_error(moduli, q) < unless else sharpened(s, moduli, q, d) for s, q, d in triples)


def _relative_error(problem: InverseProblem, place: _Place) -> float:
    """The largest bound of the reduced models' errors at a place, of the displacements in energy."""
    unknowns, objective = place.minimum.unknowns, place.objective
    moduli = problem.modulus_map.moduli(unknowns[: objective.n_parameters])
    pairs = zip(place.surrogates, objective.coefficients(unknowns), strict=True)
    return max(surrogate.relative_error(moduli, q) for surrogate, q in pairs)


def _from_starts(
    objective: Objective,
    settings: InversionSettings,
    coefficients: NDArray[np.float64],
    progress: Callable[[str], None],
) -> tuple[Minimum, ...]:
    """A minimum from every start, the first with the drivers' motion (n_coefficients,), the others with its result."""
    minima: list[Minimum] = []
    for number, theta in enumerate(settings.starts):
        motion = minima[0].unknowns[len(theta) :] if minima else coefficients
        first = driven(objective, theta, bounds=settings.bounds, coefficients=motion, max_steps=FIRST_STEPS)
        fresh = objective.with_fresh_correspondence(first.unknowns)
        minima.append(minimised(fresh, first.unknowns, settings, tolerance=1e-2))
        progress(f"start {number + 1} of {len(settings.starts)}: {len(minima[-1].history)} steps")
    return tuple(minima)


def _reduced(surrogates: tuple[Surrogate, ...]) -> tuple[ReducedModel, ...]:
    return tuple(surrogate.reduced for surrogate in surrogates)
