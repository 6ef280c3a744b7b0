"""From models and observations to the moduli that explain the later images: start, search, starts, the case's law."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from palpate.approximation.expansion import Expansion, coarse_equilibrium, expansion_around
from palpate.inversion.later_state import InverseProblem, LaterState
from palpate.inversion.mixture import Mixture
from palpate.inversion.objective import Evaluation, Objective
from palpate.inversion.optimise import Bounds, Minimum, same_minimum
from palpate.inversion.search import REPORTED, ROUGH, Searched, StopRule, approached, begun, likely_minima, searched
from palpate.inversion.starts import StartRun, informed_start, started
from palpate.mechanics.forward import SolveCounts
from palpate.parallel import blas_on_one_thread
from palpate.progress import Line, Progress, during

EQUILIBRIUM = 1e-5  # relative residual of the forces while the estimate still moves


@dataclass(frozen=True, slots=True)
class InversionSettings:
    """Starts theta (n_parameters,) each, and their bounds; the first minimum is sought from their `centre`."""

    starts: tuple[NDArray[np.float64], ...]
    bounds: Bounds
    further: tuple[NDArray[np.float64], ...] = ()

    @property
    def every_start(self) -> tuple[NDArray[np.float64], ...]:
        """All starts (n_parameters,), the further ones last."""
        return self.starts + self.further

    @property
    def centre(self) -> NDArray[np.float64]:
        """Theta (n_parameters,) at the middle of the bounds, or at the end of the starts' range nearest to it.

        Two sets of starts about it are judged from one minimum, of one problem.
        """
        starts = np.stack(self.starts)
        return np.clip(0.5 * (self.bounds.lower + self.bounds.upper), starts.min(axis=0), starts.max(axis=0))


@dataclass(frozen=True, slots=True)
class Inversion:
    """The posterior, every start, and the evaluation at no motion (`rest`).

    objective: that of the likeliest explanation, with its approximations and noise models; minimum: all unknowns at the
    posterior's mean of theta, with their evaluation, the outcome, and the way there. evaluations, counts: what it cost.
    """

    objective: Objective
    minimum: Minimum
    mixture: Mixture
    starts: tuple[StartRun, ...]
    rest: Evaluation
    evaluations: int
    counts: SolveCounts


@blas_on_one_thread()
def invert(
    problem: InverseProblem, settings: InversionSettings, *, progress: Progress, rule: StopRule = REPORTED
) -> Inversion:
    """Estimate log-moduli and drivers' motion together, from all starts, with the linear law first.

    States that bring an approximation are estimated on it; for the others a reduced basis is made at the middle of the
    bounds and extended where the estimate goes. rule: when the estimate ends; a linear one that another law follows
    ends near. Other minima, to which starts lead, are among what is compared. Raises `EstimationError`s of solving; an
    estimate that did not converge says so in its minimum's outcome.
    """
    bounds, n = settings.bounds, problem.parameters.n_parameters
    theta, counts = of_one_image(problem.linear(), settings, progress=progress)
    start = informed_start(problem, theta, progress=progress)
    nothing = np.zeros(len(start.minimum.unknowns))
    rest = start.objective.rematched(nothing)(nothing)
    finite = problem.finite_strain
    near = searched(start, bounds, ROUGH if finite else rule, progress=progress, title="linear law")
    progress(f"{len(settings.every_start)} starts, with the closest points there")
    runs = started(near.cheapest(), near.minimum.unknowns, settings.every_start, bounds)
    distinct = [
        run.minimum.unknowns
        for i, run in enumerate(runs)
        if run.minimum.converged
        and not same_minimum(run.minimum.unknowns, near.posterior.minimum, n)
        and run.candidate not in [other.candidate for other in runs[:i]]
    ]
    others = likely_minima(near, distinct, bounds)
    if finite:
        best = near.objective.parameters.in_words(near.minimum.unknowns)
        progress(Line(f"{best} by the linear law; now at finite strain", "check the law"))
        near = at_finite_strain(near, progress=during("check the law", progress))
    end = near
    if finite or others:
        title = "finite strain" if finite else "linear law, other minima too"
        end = searched(near, bounds, rule, progress=progress, title=title, begins=others)
    if finite and end.minimum.converged:
        progress("finite strain: the exact equilibrium at the estimate")
        end = end.at_equilibrium()
    return Inversion(
        end.objective, end.minimum, end.posterior, runs, rest, 1 + end.minimum.evaluations, counts + end.counts
    )


def of_one_image(
    problem: InverseProblem, settings: InversionSettings, *, progress: Progress
) -> tuple[NDArray[np.float64], SolveCounts]:
    """Theta (n_parameters,) where a linear problem's first minimum is sought, and what it cost to find.

    Of one later image that is the centre of the settings; of several, where the one that moved most leads from there.
    The responses of all are then made near where they are needed. Raises as `invert` does.
    """
    if len(problem.states) == 1 or any(state.approximation for state in problem.states):
        return settings.centre, SolveCounts()
    most = max(range(len(problem.states)), key=lambda s: problem.states[s].motion_mm2)
    alone = InverseProblem((replace(problem.states[most], reference=0),), problem.parameters.alone(most)[0])
    start = informed_start(alone, settings.centre, progress=progress)
    found = approached(start, settings.bounds, progress=progress, title="one later image")
    return found.minimum.unknowns[: alone.parameters.n_parameters], found.counts


def at_finite_strain(near: Searched, *, progress: Progress) -> Searched:
    """Where a search under the linear law goes on: at expansions of its states' `finite_strain` models.

    Far from there the states bend as the linear law's reduced bases do. Raises as `invert` does.
    """
    progress("finite strain: the equilibrium at the linear estimate")
    before, at = near.objective, near.minimum
    expansions, states = list[Expansion](), list[LaterState]()
    points = before.linearisation_points(at.unknowns)
    for state, basis, point in zip(before.states, before.approximations, points, strict=True):
        assert state.finite_strain is not None
        coarse = coarse_equilibrium(state.finite_strain, basis, point)
        expansions.append(expansion_around(coarse, tolerance=EQUILIBRIUM, progress=progress))
        states.append(replace(state, approximation=None, bending=basis))
    objective = replace(before, states=tuple(states)).with_approximations(expansions)
    there = begun(objective, at.unknowns, history=at.history, evaluations=at.evaluations)
    return replace(there, mixture=near.mixture, group=near.group)


@blas_on_one_thread()
def first_noise_of(
    problem: InverseProblem, settings: InversionSettings, *, progress: Progress
) -> tuple[Objective, Minimum]:
    """What an estimate begins with under the linear law: the objective under the noise that the images show, and where.

    Its minimum is the first one, and no estimate: no start was tried. Raises as `invert` does.
    """
    start = informed_start(problem.linear(), settings.centre, progress=progress)
    nearby = searched(start, settings.bounds, ROUGH, progress=progress, title="the first minimum")
    return nearby.objective, nearby.minimum
