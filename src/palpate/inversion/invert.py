"""From models and targets to the moduli that explain the later images: starts, weights, exact models, minima."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from palpate.errors import NotConverged
from palpate.inversion.gauss_newton import Bounds, Minimum, gauss_newton
from palpate.inversion.lbfgs import lbfgs
from palpate.inversion.modulus_map import ModulusMap
from palpate.inversion.noise import NoiseLaw, fit_noise_law
from palpate.inversion.objective import Evaluation, Linearisation, Objective, State, Weighting
from palpate.inversion.surrogate import Surrogate, enriched, first_surrogate, with_modulus_series
from palpate.mechanics.forward import SolveCounts
from palpate.mechanics.linear_model import LinearModel
from palpate.observation.target import SurfaceTarget

__all__ = ["InverseProblem", "Inversion", "InversionSettings", "fit_driver", "invert", "invert_with"]

TUKEY = 4.685  # cutoff in standard deviations, 95 % efficient for normal errors (Huber 1981)
MAD = 1.4826  # standard deviations of a normal law in one median absolute deviation
LEAST_CUTOFF = 5e-3  # mm
FIRST_LAW = NoiseLaw(np.array([0.3**2]), np.array([3.0]))  # until the residuals tell
SAME_MINIMUM = 0.02  # of ln E
ROUNDS = 7
SETTLED = 0.05  # posterior standard deviations by which a round may still move the estimate
EXACT = 3e-3  # standard deviations of a residual, per mm of motion: a smaller model error needs no further snapshot
POLISH = 1e-5  # decrement of the reported minimum


@dataclass(frozen=True, slots=True)
class InverseProblem:
    """One model and the surfaces of one later image, for each later image; unknown moduli by `modulus_map`."""

    models: tuple[LinearModel, ...]
    targets: tuple[tuple[SurfaceTarget, ...], ...]
    modulus_map: ModulusMap
    estimated: frozenset[str]


@dataclass(frozen=True, slots=True)
class InversionSettings:
    """Starts theta (n_parameters,) each, their bounds, the optimiser's name; `law` None: from the residuals."""

    starts: tuple[NDArray[np.float64], ...]
    bounds: Bounds
    method: str = "gauss-newton"
    law: NoiseLaw | None = None


@dataclass(frozen=True, slots=True)
class Inversion:
    """All starts' minima under the final objective, the best one's number; the law of the residuals.

    rest: the evaluation at no motion; `settled` is False when weights and estimate still changed each other at the end.
    """

    objective: Objective
    minima: tuple[Minimum, ...]
    groups: tuple[int, ...]
    best: int
    law: NoiseLaw
    surrogates: tuple[Surrogate, ...]
    rest: Evaluation
    settled: bool = True
    evaluations: int = 0
    counts: SolveCounts = field(default_factory=SolveCounts)

    @property
    def minimum(self) -> Minimum:
        """The minimum with the smallest objective."""
        return self.minima[self.best]


def invert(problem: InverseProblem, settings: InversionSettings, *, progress: Callable[[str], None]) -> Inversion:
    """Estimate log-moduli and driver motion together, from all starts.

    The reduced models are made at the middle start and enriched at the estimate until it no longer moves.
    """
    middle = np.median(np.stack(settings.starts), axis=0)
    moduli = problem.modulus_map.moduli(middle)
    progress("responses of the full model at the middle start")
    surrogates = tuple(first_surrogate(model, moduli) for model in problem.models)
    objective = _objective(problem, surrogates, settings.law or FIRST_LAW)
    held = np.concatenate([middle, np.zeros(objective.n_unknowns - len(middle))])
    objective = objective.with_fresh_correspondence(held)
    driven = gauss_newton(objective, held, bounds=settings.bounds, hold_theta=True, tolerance=1e-2)
    pairs = zip(surrogates, objective.coefficients(driven.unknowns), strict=True)
    surrogates = tuple(with_modulus_series(s, q, problem.modulus_map.columns) for s, q in pairs)
    return invert_with(problem, settings, surrogates, progress=progress)


def invert_with(
    problem: InverseProblem,
    settings: InversionSettings,
    surrogates: tuple[Surrogate, ...],
    *,
    progress: Callable[[str], None],
) -> Inversion:
    """The same from reduced models that are already there."""
    law = settings.law or FIRST_LAW
    objective = _objective(problem, surrogates, law)
    still = np.zeros(objective.n_unknowns)
    objective = objective.with_fresh_correspondence(still)
    rest = objective(still)
    minima = _from_starts(objective, settings, progress)
    chosen = _best(minima)
    best = minima[chosen]
    settled = False
    for round_ in range(ROUNDS):
        progress(f"round {round_ + 1}: {_words(problem, best)}; the full model is solved there")
        surrogates = _enriched(problem, surrogates, objective, best, exact=min(EXACT * law.sd, 1e-3))
        law = settings.law or _law(problem, best.evaluation)
        objective = _reweighted(_objective(problem, surrogates, law), best, law)
        before, best = best, _continued(objective, best, settings)
        settled = _settled(before, best, objective.n_parameters)
        if settled:
            break
    best = _continued(objective, best, settings, tolerance=POLISH)
    driven = [_with_driver(m, best, objective.n_parameters) for m in minima]
    minima = tuple(best if i == chosen else _continued(objective, m, settings) for i, m in enumerate(driven))
    counts = sum((s.counts for s in surrogates), SolveCounts())
    return Inversion(
        objective,
        minima,
        _groups(minima, objective.n_parameters),
        _best(minima),
        law,
        surrogates,
        rest,
        settled,
        evaluations=sum(len(minimum.history) for minimum in minima),
        counts=counts,
    )


def _enriched(
    problem: InverseProblem,
    surrogates: tuple[Surrogate, ...],
    objective: Objective,
    minimum: Minimum,
    *,
    exact: float,
) -> tuple[Surrogate, ...]:
    """Solve the full models at a minimum where the reduced ones' relative error is above `exact`."""
    moduli = problem.modulus_map.moduli(minimum.unknowns[: objective.n_parameters])
    pairs = zip(surrogates, objective.coefficients(minimum.unknowns), strict=True)
    return tuple(s if s.relative_error(moduli, q) < exact else enriched(s, moduli, q) for s, q in pairs)


def fit_driver(problem: InverseProblem, moduli: NDArray[np.float64]) -> tuple[NDArray[np.float64], ...]:
    """Displacements (n_points, 3) mm of each later image at given moduli (n_regions,) kPa, the driver fitted to it.

    Raises `NotConverged` when the driver's wall cannot be brought to the images.
    """
    surrogates = tuple(first_surrogate(model, moduli) for model in problem.models)
    held = replace(problem, modulus_map=replace(problem.modulus_map, base=moduli))
    n = len(held.modulus_map.tissues)
    bounds = Bounds(np.full(n, -1.0), np.full(n, 1.0))
    objective = _objective(held, surrogates, FIRST_LAW)
    unknowns = np.zeros(objective.n_unknowns)
    for _ in range(2):
        objective = objective.with_fresh_correspondence(unknowns)
        found = gauss_newton(objective, unknowns, bounds=bounds, hold_theta=True, tolerance=1e-2)
        unknowns = found.unknowns
    if not found.outcome.converged:
        raise NotConverged(f"the driver's wall could not be fitted to the later image: {found.outcome.value}")
    parts = zip(surrogates, objective.coefficients(unknowns), strict=True)
    return tuple(surrogate.reduced.solve(moduli, q).displacement for surrogate, q in parts)


def _from_starts(
    objective: Objective, settings: InversionSettings, progress: Callable[[str], None]
) -> tuple[Minimum, ...]:
    minima: list[Minimum] = []
    for number, theta in enumerate(settings.starts):
        driver = minima[0].unknowns[len(theta) :] if minima else np.zeros(objective.n_unknowns - len(theta))
        unknowns = np.concatenate([theta, driver])
        first = gauss_newton(objective, unknowns, bounds=settings.bounds, hold_theta=True, tolerance=1e-2)
        fresh = objective.with_fresh_correspondence(first.unknowns)
        minima.append(_minimise(fresh, first.unknowns, settings, tolerance=1e-2))
        progress(f"start {number + 1} of {len(settings.starts)}: {len(minima[-1].history)} steps")
    return tuple(minima)


def _minimise(
    objective: Objective, start: NDArray[np.float64], settings: InversionSettings, *, tolerance: float = 1e-3
) -> Minimum:
    if settings.method == "lbfgs":
        return lbfgs(objective, start, bounds=settings.bounds, tolerance=tolerance)
    return gauss_newton(objective, start, bounds=settings.bounds, tolerance=tolerance)


def _continued(
    objective: Objective, minimum: Minimum, settings: InversionSettings, *, tolerance: float = 1e-3
) -> Minimum:
    """Go on from a minimum under a new objective; the history goes on, too."""
    found = _minimise(objective, minimum.unknowns, settings, tolerance=tolerance)
    return replace(found, history=minimum.history + found.history)


def _objective(problem: InverseProblem, surrogates: tuple[Surrogate, ...], law: NoiseLaw) -> Objective:
    states = tuple(
        State(s.reduced.at(np.concatenate([t.surface.dofs for t in targets])), targets)
        for s, targets in zip(surrogates, problem.targets, strict=True)
    )
    precision, noise = _precision(problem, law), law.sd**2 * law.correlation_area
    weighting = tuple(
        tuple(Weighting(precision, np.inf, np.ones(len(t.image_points), dtype=bool), noise) for t in targets)
        for targets in problem.targets
    )
    return Objective(states, problem.modulus_map, weighting)


def _precision(problem: InverseProblem, law: NoiseLaw) -> float:
    """Weight (mm^-2) of a surface's mean square: independent residuals on a mean surface, by their variance."""
    areas = [float(target.area.sum()) for targets in problem.targets for target in targets]
    return max(float(np.mean(areas)) / law.correlation_area, 1.0) / law.sd**2


def _with_driver(minimum: Minimum, best: Minimum, n_parameters: int) -> Minimum:
    """The moduli of a minimum with the driver's motion of the best one, which the later rounds have refined."""
    unknowns = np.concatenate([minimum.unknowns[:n_parameters], best.unknowns[n_parameters:]])
    return replace(minimum, unknowns=unknowns)


def _reweighted(objective: Objective, minimum: Minimum, law: NoiseLaw) -> Objective:
    """Tukey cutoffs from the residuals at a minimum, and image points chosen anew there.

    A surface that fits worse than the law of the residuals (a driver whose modes cannot follow its wall) counts by its
    own mean square, so that its misfit is not forced into the other unknowns.
    """
    lines = iter(minimum.evaluation.surfaces)
    weighting = tuple(
        tuple(_weighting_of(next(lines), weighting, law) for weighting in weightings)
        for weightings in objective.weighting
    )
    return replace(objective, weighting=weighting).with_fresh_correspondence(minimum.unknowns)


def _weighting_of(line: Linearisation, weighting: Weighting, law: NoiseLaw) -> Weighting:
    values = line.residuals.values
    cutoff = _cutoff(values)
    inside = np.abs(values) < cutoff
    mean_square = float(np.average(values[inside] ** 2, weights=line.residuals.weights[inside]))
    share = min(1.0, law.sd**2 / max(mean_square, 1e-12))
    return replace(weighting, cutoff=cutoff, precision=weighting.precision * share)


def _cutoff(values: NDArray[np.float64]) -> float:
    return max(TUKEY * MAD * float(np.median(np.abs(values))), LEAST_CUTOFF)


def _law(problem: InverseProblem, evaluation: Evaluation) -> NoiseLaw:
    """Law of the residuals of the `estimate` tissues; the driver's own are flattened by its many unknowns."""
    seen = [s.residuals for s in evaluation.surfaces if s.target.surface.name in problem.estimated]
    return fit_noise_law([r.values for r in seen], [r.places for r in seen], [r.normals for r in seen])


def _best(minima: tuple[Minimum, ...]) -> int:
    values = [m.evaluation.value if m.outcome.converged else np.inf for m in minima]
    if not np.isfinite(values).any():
        values = [m.evaluation.value for m in minima]
    return int(np.argmin(values))


def _groups(minima: tuple[Minimum, ...], n_parameters: int) -> tuple[int, ...]:
    """Number of the distinct minimum each start ended in, in the order of the starts."""
    distinct: list[NDArray[np.float64]] = []
    groups = []
    for minimum in minima:
        theta = minimum.unknowns[:n_parameters]
        same = [i for i, other in enumerate(distinct) if np.abs(theta - other).max() < SAME_MINIMUM]
        if not same:
            distinct.append(theta)
        groups.append(same[0] if same else len(distinct) - 1)
    return tuple(groups)


def _settled(before: Minimum, after: Minimum, n_parameters: int) -> bool:
    """Whether a round moved the log-moduli by little, in units of their own uncertainty."""
    inverse = np.linalg.inv(after.evaluation.matrix)[:n_parameters, :n_parameters]
    moved = np.abs(after.unknowns - before.unknowns)[:n_parameters]
    return bool(np.all(moved < SETTLED * np.sqrt(np.diag(inverse))))


def _words(problem: InverseProblem, minimum: Minimum) -> str:
    mapping = problem.modulus_map
    ratios = np.exp(minimum.unknowns[: len(mapping.tissues)])
    return ", ".join(
        f"{name} {ratio:.2f} x {mapping.relative_to}" for name, ratio in zip(mapping.tissues, ratios, strict=True)
    )
