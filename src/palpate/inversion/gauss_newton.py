"""Gauss-Newton steps on all unknowns, with a trust region on the log-moduli."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum

import numpy as np
from numpy.typing import NDArray

from palpate.inversion.objective import Evaluation, Objective

__all__ = ["Bounds", "Iterate", "Minimum", "Outcome", "gauss_newton"]

FIRST_RADIUS = 1.0  # of the log-moduli, per step: a factor e
MAX_RADIUS = 2.0
STALLED = 1e-2  # decrement under which a refused step is the noise of re-chosen closest points, whatever it moves


class Outcome(StrEnum):
    """How an iteration ended; the value is the sentence that the user reads."""

    CONVERGED = "the decrement fell under its tolerance"
    STALLED = "no smaller value was found within a tenth of the posterior's width"
    STEPS = "the iteration reached its largest number of steps; raise it, or start nearer"
    STUCK = "no step reduced the objective; look at the fit of the driver's surface and at the images"
    NOT_FINITE = "the objective is not a finite number; check the images and the moduli's bounds"

    @property
    def converged(self) -> bool:
        """Whether the point reached is a minimum."""
        return self in (Outcome.CONVERGED, Outcome.STALLED)


@dataclass(frozen=True, slots=True)
class Bounds:
    """Bounds of theta = ln(E / E_reference), (n_parameters,) each."""

    lower: NDArray[np.float64]
    upper: NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Iterate:
    """One accepted point: theta (n_parameters,), objective value, misfit (mm^2) and decrement (dimensionless)."""

    theta: NDArray[np.float64]
    value: float
    misfit_mm2: float
    decrement: float


@dataclass(frozen=True, slots=True)
class Minimum:
    """Where an iteration ended: unknowns (n,), the evaluation there, the outcome and the way to it."""

    unknowns: NDArray[np.float64]
    evaluation: Evaluation
    outcome: Outcome
    history: tuple[Iterate, ...]


@dataclass(frozen=True, slots=True)
class _Region:
    """Trust region: radius of theta, and Levenberg-Marquardt damping of all unknowns relative to the diagonal."""

    radius: float = FIRST_RADIUS
    damping: float = 0.0

    def smaller(self) -> _Region:
        """After a step that was refused."""
        return _Region(self.radius / 3.0, max(10.0 * self.damping, 1e-4))

    def larger(self) -> _Region:
        """After a step that brought what it promised."""
        return _Region(min(2.0 * self.radius, MAX_RADIUS), self.damping / 10.0 if self.damping > 1e-6 else 0.0)


def gauss_newton(
    objective: Objective,
    start: NDArray[np.float64],
    *,
    bounds: Bounds,
    hold_theta: bool = False,
    tolerance: float = 1e-3,
    still: float = np.inf,
    max_steps: int = 40,
) -> Minimum:
    """Minimise `objective` from `start` (n_unknowns,).

    Step: (J^T W J + P + mu D) d = -s, s the score, with the log-moduli's part no longer than the trust radius; a step
    is taken when it reduces the objective (Nocedal & Wright 2006, Algorithm 4.1) or lowers by a tenth the decrement
    -s.d / 2, the reduction that the quadratic model still promises in units of log-likelihood. It ends when that is
    under `tolerance` and the step to the model's minimum moves no log-modulus by more than `still`. `hold_theta` moves
    the driver's coefficients only.
    """
    unknowns, region, history = start.copy(), _Region(), list[Iterate]()
    now = objective(unknowns)
    for _ in range(max_steps):
        if not np.isfinite(now.value):
            return Minimum(unknowns, now, Outcome.NOT_FINITE, tuple(history))
        free = _free(objective, unknowns, now, bounds, hold_theta)
        decrement = _decrement(now, free)
        history.append(Iterate(unknowns[: objective.n_parameters], now.value, now.misfit_mm2, decrement))
        if decrement < tolerance and _moves(now, free, objective.n_parameters) < still:
            return Minimum(unknowns, now, Outcome.CONVERGED, tuple(history))
        found = _search(objective, unknowns, now, free=free, bounds=bounds, region=region)
        if found is None:
            near = decrement < STALLED or _near(now, free, objective.n_parameters)
            return Minimum(unknowns, now, Outcome.STALLED if near else Outcome.STUCK, tuple(history))
        unknowns, now, region = found
    return Minimum(unknowns, now, Outcome.STEPS, tuple(history))


def _search(
    objective: Objective,
    unknowns: NDArray[np.float64],
    now: Evaluation,
    *,
    free: NDArray[np.bool_],
    bounds: Bounds,
    region: _Region,
) -> tuple[NDArray[np.float64], Evaluation, _Region] | None:
    """First step that makes progress, with the region for the next; None when eight did not."""
    n = objective.n_parameters
    before = _decrement(now, free)
    for _ in range(8):
        step = _step(now, free, n, region)
        trial = unknowns + step
        trial[:n] = np.clip(trial[:n], bounds.lower, bounds.upper)
        there = objective(trial)
        promised = -now.score @ step - 0.5 * step @ now.matrix @ step
        gain = now.value - there.value
        if gain > 1e-4 * promised or _decrement(there, free) < 0.9 * before:
            return trial, there, region.larger() if gain > 0.25 * promised else region
        region = region.smaller()
    return None


def _free(
    objective: Objective, unknowns: NDArray[np.float64], now: Evaluation, bounds: Bounds, hold_theta: bool
) -> NDArray[np.bool_]:
    """Unknowns that may move: not a log-modulus at a bound that pulls outwards, nor any when theta is held."""
    n = objective.n_parameters
    theta, slope = unknowns[:n], now.score[:n]
    held = ((theta <= bounds.lower) & (slope > 0.0)) | ((theta >= bounds.upper) & (slope < 0.0)) | hold_theta
    return np.concatenate([~held, np.ones(len(unknowns) - n, dtype=bool)])


def _decrement(now: Evaluation, free: NDArray[np.bool_]) -> float:
    matrix, score = now.matrix[np.ix_(free, free)], now.score[free]
    return float(0.5 * score @ _solve(matrix, score))


def _moves(now: Evaluation, free: NDArray[np.bool_], n_parameters: int) -> float:
    """Largest change of a log-modulus by the step to the minimum of the quadratic model."""
    return float(np.abs(_step(now, free, n_parameters, _Region(np.inf, 0.0))[:n_parameters]).max(initial=0.0))


def _near(now: Evaluation, free: NDArray[np.bool_], n_parameters: int) -> bool:
    """Whether the step that finds no smaller value is the noise of re-chosen closest points.

    It moves every free log-modulus by less than a tenth of its posterior width, and promises less than a thousandth of
    the objective (a hundredth where the moduli are held and only the driver moves).
    """
    step = _step(now, free, n_parameters, _Region(np.inf, 0.0))[:n_parameters]
    inverse = np.linalg.inv(now.matrix[np.ix_(free, free)])
    width = np.full(n_parameters, np.inf)
    moving = free[:n_parameters]
    width[moving] = np.sqrt(np.diag(inverse)[: int(moving.sum())])
    small = bool(np.all(np.abs(step) < 0.1 * width))
    share = 1e-3 if moving.any() else 1e-2
    return small and _decrement(now, free) < share * now.value + STALLED


def _step(now: Evaluation, free: NDArray[np.bool_], n_parameters: int, region: _Region) -> NDArray[np.float64]:
    """Damped Gauss-Newton step (n,) whose log-moduli stay within the radius."""
    matrix = now.matrix + region.damping * np.diag(np.diag(now.matrix))
    ridge = np.diag(np.where(np.arange(len(free)) < n_parameters, np.diag(now.matrix), 0.0))
    step = np.zeros(len(free))
    weight = 0.0
    for _ in range(60):
        step[free] = -_solve((matrix + weight * ridge)[np.ix_(free, free)], now.score[free])
        if np.abs(step[:n_parameters]).max(initial=0.0) <= region.radius * 1.01:
            break
        weight = max(2.0 * weight, 0.05)
    return step


def _solve(matrix: NDArray[np.float64], rhs: NDArray[np.float64]) -> NDArray[np.float64]:
    """Solve a positive semi-definite system scaled to a unit diagonal, with a trace of ridge against rank loss."""
    scale = 1.0 / np.sqrt(np.maximum(np.diag(matrix), 1e-30))
    scaled = scale[:, None] * matrix * scale
    scaled[np.diag_indices_from(scaled)] += 1e-12
    return np.asarray(scale * np.linalg.solve(scaled, scale * rhs))
