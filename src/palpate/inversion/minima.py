"""Minima of an objective: found, continued under another one, compared with each other."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from palpate.inversion.gauss_newton import Bounds, Minimum, gauss_newton
from palpate.inversion.lbfgs import lbfgs
from palpate.inversion.objective import Objective
from palpate.inversion.problem import InverseProblem, InversionSettings

__all__ = [
    "SETTLED",
    "best_of",
    "change_between",
    "continued",
    "driven",
    "groups_of",
    "minimised",
    "moved_between",
    "posterior_sd",
    "with_driver",
    "words",
]

SAME_MINIMUM = 0.02  # of ln E
DRIVEN = 1e-2  # decrement of the drivers' motion at held moduli, which other unknowns are going to change
POLISH = 1e-5  # decrement of a minimum by a method that does not tell how far the log-moduli are from it
SETTLED = 0.05  # posterior standard deviations by which a round may still move the estimate


def driven(
    objective: Objective,
    theta: NDArray[np.float64],
    *,
    bounds: Bounds,
    coefficients: NDArray[np.float64] | None = None,
    max_steps: int = 40,
) -> Minimum:
    """The best motion of the drivers at held log-moduli theta (n_parameters,), to a decrement of 1e-2.

    coefficients (n_coefficients,), where the search begins; None: at rest. It is left where it is after `max_steps`.
    """
    motion = np.zeros(objective.n_unknowns - len(theta)) if coefficients is None else coefficients
    start = np.concatenate([theta, motion])
    return gauss_newton(objective, start, bounds=bounds, hold_theta=True, tolerance=DRIVEN, max_steps=max_steps)


def minimised(
    objective: Objective,
    start: NDArray[np.float64],
    settings: InversionSettings,
    *,
    tolerance: float = 1e-3,
    still: float = np.inf,
) -> Minimum:
    """The minimum from `start` (n_unknowns,) by the method of the settings.

    `tolerance` of the decrement; `still`: how far the log-moduli may yet be from it.
    """
    if settings.method == "lbfgs":
        polish = min(tolerance, POLISH) if np.isfinite(still) else tolerance
        return lbfgs(objective, start, bounds=settings.bounds, tolerance=polish)
    return gauss_newton(objective, start, bounds=settings.bounds, tolerance=tolerance, still=still)


def continued(
    objective: Objective,
    minimum: Minimum,
    settings: InversionSettings,
    *,
    tolerance: float = 1e-3,
    still: float = np.inf,
) -> Minimum:
    """Go on from a minimum under a new objective; the history goes on, too."""
    found = minimised(objective, minimum.unknowns, settings, tolerance=tolerance, still=still)
    return replace(found, history=minimum.history + found.history)


def with_driver(minimum: Minimum, best: Minimum, n_parameters: int) -> Minimum:
    """The moduli of a minimum with the driver's motion of the best one, which the later rounds have refined."""
    unknowns = np.concatenate([minimum.unknowns[:n_parameters], best.unknowns[n_parameters:]])
    return replace(minimum, unknowns=unknowns)


def best_of(minima: tuple[Minimum, ...]) -> int:
    """Number of the converged minimum with the smallest value; of them all when none converged."""
    values = [m.evaluation.value if m.outcome.converged else np.inf for m in minima]
    if not np.isfinite(values).any():
        values = [m.evaluation.value for m in minima]
    return int(np.argmin(values))


def groups_of(minima: tuple[Minimum, ...], n_parameters: int) -> tuple[int, ...]:
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


def change_between(before: Minimum, after: Minimum, n_parameters: int) -> NDArray[np.float64]:
    """Change of the log-moduli (n_parameters,) without its sign."""
    return np.asarray(np.abs(after.unknowns - before.unknowns)[:n_parameters])


def posterior_sd(minimum: Minimum, n_parameters: int) -> NDArray[np.float64]:
    """Standard deviations (n_parameters,) of the log-moduli by the Gauss-Newton matrix."""
    inverse = np.linalg.inv(minimum.evaluation.matrix)[:n_parameters, :n_parameters]
    return np.asarray(np.sqrt(np.diag(inverse)))


def moved_between(before: Minimum, after: Minimum, n_parameters: int) -> float:
    """Largest change of a log-modulus in posterior standard deviations."""
    moved = change_between(before, after, n_parameters) / posterior_sd(after, n_parameters)
    return float(np.max(moved, initial=0.0))


def words(problem: InverseProblem, minimum: Minimum) -> str:
    """The moduli at a minimum in words, for the progress."""
    mapping = problem.modulus_map
    ratios = np.exp(minimum.unknowns[: len(mapping.tissues)])
    return ", ".join(
        f"{name} {ratio:.2f} x {mapping.relative_to}" for name, ratio in zip(mapping.tissues, ratios, strict=True)
    )
