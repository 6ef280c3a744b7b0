"""Minima of a smooth least-squares objective over all unknowns: Gauss-Newton with a trust region on the log-moduli."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from enum import StrEnum
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from palpate.errors import SolverError
from palpate.inversion.objective import Evaluation
from palpate.unknowns.arrowhead import Arrowhead, Eliminated

RADIUS = 2.0  # largest trust radius of the log-moduli; the first one is half of it
LEAST_DAMPING = 0.1  # of the diagonal: with less the step is nearly the refused one
BAD = 0.25  # of the promised reduction: below, the radius shrinks; above 1 - 0.25 it grows (Nocedal & Wright, Alg. 4.1)
TRIALS = 12  # trials of a step before it fails
AT_BOUND = 1e-9  # of ln E: rounding of a mean of values at a bound
RIDGE = 1e-12  # of the diagonal, which prevents a singular matrix
SAME_MINIMUM = 0.02  # of ln E: minima that are nearer to each other count as one


class LeastSquares(Protocol):
    """What Gauss-Newton minimises: the objective, or one with linear residuals."""

    @property
    def n_parameters(self) -> int:
        """Number of log-moduli among the unknowns."""
        ...

    def __call__(self, unknowns: NDArray[np.float64]) -> Evaluation:
        """Value, score and Gauss-Newton matrix at `unknowns` (n_unknowns,)."""
        ...


class Outcome(StrEnum):
    """How an iteration ended; the value is the sentence that the user reads."""

    CONVERGED = "the search ended by its tolerance"
    STEPS = "the iteration reached its largest number of steps"
    STUCK = "no step reduced the objective; check the images and the fit of the driver's surface"
    UNSOLVABLE = "every shorter step led to a state that cannot be solved, for example with elements inside out"
    NOT_FINITE = "the objective is not a finite number; check the images and the moduli's bounds"

    @property
    def converged(self) -> bool:
        """Whether the point reached is a minimum."""
        return self is Outcome.CONVERGED


@dataclass(frozen=True, slots=True)
class Bounds:
    """Bounds of theta = ln(E / E_reference), (n_parameters,) each; within: wider ones, of which they are a part."""

    lower: NDArray[np.float64]
    upper: NDArray[np.float64]
    within: Bounds | None = None

    @property
    def room(self) -> NDArray[np.float64]:
        """Their distance (n_parameters,); that of the wider ones where they are a part."""
        return self.upper - self.lower if self.within is None else self.within.room

    def around(self, theta: NDArray[np.float64], radius: float) -> Bounds:
        """Their part within a radius of theta (n_parameters,)."""
        return Bounds(np.maximum(self.lower, theta - radius), np.minimum(self.upper, theta + radius), self)

    def reached(self, theta: NDArray[np.float64]) -> NDArray[np.bool_]:
        """Which of theta (n_parameters,) lie at a bound: what holds them there is the search, not the images."""
        return np.asarray((theta <= self.lower + AT_BOUND) | (theta >= self.upper - AT_BOUND))

    def fixed(self, theta: NDArray[np.float64], which: NDArray[np.bool_]) -> Bounds:
        """Those between which the log-moduli `which` (n_parameters,) keep their values theta (n_parameters,)."""
        return Bounds(np.where(which, theta, self.lower), np.where(which, theta, self.upper))

    def free(self, unknowns: NDArray[np.float64], score: NDArray[np.float64]) -> NDArray[np.bool_]:
        """Which unknowns (n,) may move: no log-modulus without room, or that the score (n,) pulls out of a bound."""
        n = len(self.lower)
        theta, slope = unknowns[:n], score[:n]
        still = ((theta <= self.lower) & (slope > 0.0)) | ((theta >= self.upper) & (slope < 0.0))
        still |= self.lower >= self.upper
        return np.concatenate([~still, np.ones(len(unknowns) - n, dtype=bool)])


@dataclass(frozen=True, slots=True)
class Iterate:
    """One accepted point: theta (n_parameters,), objective value, misfit (mm^2) and decrement (dimensionless)."""

    theta: NDArray[np.float64]
    value: float
    misfit_mm2: float
    decrement: float

    @classmethod
    def of(cls, unknowns: NDArray[np.float64], at: Evaluation, n_parameters: int) -> Iterate:
        """That of unknowns (n_unknowns,) with their evaluation."""
        return cls(unknowns[:n_parameters], at.value, at.misfit_mm2, newton_decrement(at))


@dataclass(frozen=True, slots=True)
class Minimum:
    """Where an iteration ended: unknowns (n,), the evaluation there, the outcome, the way to it, what it cost."""

    unknowns: NDArray[np.float64]
    evaluation: Evaluation
    outcome: Outcome
    history: tuple[Iterate, ...]
    evaluations: int = 0

    @property
    def converged(self) -> bool:
        """Whether it is a minimum."""
        return self.outcome.converged


@dataclass(frozen=True, slots=True)
class TrustRegion:
    """The largest step of a log-modulus, and Levenberg-Marquardt damping of all unknowns relative to the diagonal."""

    radius: float = 0.5 * RADIUS
    damping: float = 0.0

    def smaller(self, longest: float, *, damps: bool = False) -> TrustRegion:
        """After a step that was refused, whose `longest` log-modulus is known.

        It is damped only where shortening log-moduli does not help (`damps`), or none is left to be shortened: damping
        all unknowns ends a step along a valley. A radius that such steps shortened would stay so: it grows no more
        where the others are what was too long.
        """
        if longest > SAME_MINIMUM and not damps:
            return TrustRegion(0.5 * min(self.radius, longest), self.damping)
        return TrustRegion(self.radius, max(4.0 * self.damping, LEAST_DAMPING))

    def after(self, share: float, longest: float, *, grows: bool = True) -> TrustRegion:
        """After a step that was taken, which brought a `share` of what it promised."""
        damping = self.damping / 4.0 if self.damping > LEAST_DAMPING else 0.0
        if share < BAD and longest > SAME_MINIMUM:
            return TrustRegion(0.5 * min(self.radius, longest), damping)
        return TrustRegion(min(2.0 * self.radius, RADIUS) if share > 1.0 - BAD and grows else self.radius, damping)


def posterior_sd(minimum: Minimum, n_parameters: int) -> NDArray[np.float64]:
    """Standard deviations (n_parameters,) of the log-moduli by the Gauss-Newton matrix.

    Infinite where a modulus moves nothing, as in a body at rest. Raises `EstimationError` where neither images nor
    prior determine some other unknown.
    """
    covariance = minimum.evaluation.covariance_columns(n_parameters)[:n_parameters]
    return np.asarray(np.sqrt(np.diag(covariance)))


def same_minimum(unknowns: NDArray[np.float64], minimum: Minimum, n_parameters: int) -> bool:
    """Whether unknowns (n_unknowns,) lie so near a minimum that both are one: within a posterior standard deviation.

    Two normal densities up to two apart have one mode together.
    """
    width = np.maximum(SAME_MINIMUM, posterior_sd(minimum, n_parameters))
    return bool(np.all(np.abs(unknowns - minimum.unknowns)[:n_parameters] < width))


def grouped(minima: Sequence[Minimum], n_parameters: int) -> list[int]:
    """Number of the distinct minimum that each one is, in their order."""
    distinct: list[Minimum] = []
    groups = []
    for minimum in minima:
        same = [i for i, other in enumerate(distinct) if same_minimum(minimum.unknowns, other, n_parameters)]
        if not same:
            distinct.append(minimum)
        groups.append(same[0] if same else len(distinct) - 1)
    return groups


def gauss_newton(
    objective: LeastSquares,
    start: NDArray[np.float64],
    *,
    bounds: Bounds,
    tolerance: float = 1e-3,
    within: NDArray[np.float64] | float = np.inf,
    max_steps: int = 40,
    begin: Evaluation | None = None,
) -> Minimum:
    """Minimise `objective` from `start` (n_unknowns,), where it is `begin` if that is known.

    Step: (J^T W J + P + mu D) d = -s, s the score, with the log-moduli's part no longer than the trust radius; a step
    is taken when it reduces the objective (Nocedal & Wright 2006, Algorithm 4.1). It ends when the decrement -s.d / 2,
    the reduction that the quadratic model still promises in units of log-likelihood, is under `tolerance` and the step
    to the model's minimum moves each log-modulus by less than `within` (one number, or (n_parameters,)).
    """
    unknowns, region, history, n = start.copy(), TrustRegion(), list[Iterate](), objective.n_parameters
    now, evaluations, outcome = begin or objective(unknowns), 1, Outcome.STEPS
    for _ in range(max_steps):
        if not np.isfinite(now.value):
            outcome = Outcome.NOT_FINITE
            break
        quadratic = _QuadraticModel.of(now, bounds.free(unknowns, now.score), n)
        whole = quadratic.step()
        decrement = -0.5 * float(now.score @ whole)
        history.append(Iterate(unknowns[:n], now.value, now.misfit_mm2, decrement))
        if decrement < tolerance and np.all(np.abs(whole[:n]) < within):
            outcome = Outcome.CONVERGED
            break
        found, trials, solved = _search(objective, unknowns, now, quadratic, bounds=bounds, region=region)
        evaluations += trials
        if found is None:
            near = decrement < tolerance
            outcome = Outcome.CONVERGED if near else Outcome.STUCK if solved else Outcome.UNSOLVABLE
            break
        unknowns, now, region = found
    return Minimum(unknowns, now, outcome, tuple(history), evaluations)


def _search(
    objective: LeastSquares,
    unknowns: NDArray[np.float64],
    now: Evaluation,
    undamped: _QuadraticModel,
    *,
    bounds: Bounds,
    region: TrustRegion,
) -> tuple[tuple[NDArray[np.float64], Evaluation, TrustRegion] | None, int, bool]:
    """First step that reduces the objective, with the next region, or None; evaluations; whether any trial was solved.

    Where the objective bends more along a step d than its matrix says, the step brings too little. It then ends at the
    secant's root of the slopes s.d at its ends, if the objective is lower there.
    """
    n, solved, spent = objective.n_parameters, False, 0
    for _ in range(TRIALS):
        quadratic = _QuadraticModel.of(now, undamped.free, n, damping=region.damping) if region.damping else undamped
        trial = unknowns + quadratic.step(region.radius)
        trial[:n] = np.clip(trial[:n], bounds.lower, bounds.upper)
        step = trial - unknowns
        longest = float(np.abs(step[:n]).max(initial=0.0))
        slope = float(now.score @ step)
        promised = -slope - 0.5 * float(step @ (now.matrix @ step))
        spent += 1
        try:
            there = objective(trial)
        except SolverError:  # elements would turn inside out
            region = region.smaller(longest)
            continue
        solved, gain, rises = True, now.value - there.value, float(there.score @ step)
        if promised > 0.0 and gain < BAD * promised and slope < 0.0 < rises:
            nearer, spent = unknowns + slope / (slope - rises) * step, spent + 1
            with suppress(SolverError):
                between = objective(nearer)
                if between.value < min(now.value, there.value):
                    return (nearer, between, region), spent, True
        if promised > 0.0 and gain > 1e-4 * promised:  # a step that a bound cuts may lead uphill
            return (trial, there, region.after(float(gain / promised), longest)), spent, True
        region = region.smaller(longest)
    return None, spent, solved


def newton_step(now: Evaluation, free: NDArray[np.bool_], n_parameters: int) -> NDArray[np.float64]:
    """-H^-1 s (n,) of the unknowns that are free (n,): the step to the minimum of the quadratic model, however long."""
    return _QuadraticModel.of(now, free, n_parameters).step()


def newton_decrement(now: Evaluation) -> float:
    """s^T H^-1 s / 2 of score s and Gauss-Newton matrix H: what a step of all unknowns still promises."""
    eliminated = _ridged(now.matrix, 0).eliminated()
    halves, right = eliminated.right(now.score)
    return float(0.5 * now.score @ eliminated.followed(halves, _solve(eliminated.left, right[:, None])[:, 0]))


@dataclass(frozen=True, slots=True)
class _QuadraticModel:
    """An objective with the score s and the matrix H around a point, all but its free log-moduli eliminated.

    free (n,): which unknowns move. Each image's own unknowns are `eliminated`, halves (n_k,) are theirs of the score
    (see `Eliminated`). Steps d of the free log-moduli t and the other shared unknowns q then have H_qq d_q = -s_q -
    H_qt d_t, hence d_q = -rest - slopes d_t, rest (m,) and slopes (m, k). matrix (k, k): H_tt - H_tq slopes; score
    (k,): s_t - H_tq rest; diagonal (k,): of H_tt before any elimination.
    """

    free: NDArray[np.bool_]
    eliminated: Eliminated
    halves: tuple[NDArray[np.float64], ...]
    matrix: NDArray[np.float64]
    score: NDArray[np.float64]
    diagonal: NDArray[np.float64]
    slopes: NDArray[np.float64]
    rest: NDArray[np.float64]

    @classmethod
    def of(
        cls, now: Evaluation, free: NDArray[np.bool_], n_parameters: int, *, damping: float = 0.0
    ) -> _QuadraticModel:
        """Around an evaluation, with the damped matrix H + damping diag H."""
        moduli = np.flatnonzero(free[:n_parameters])
        diagonal = now.matrix.diagonal
        damped = now.matrix.plus_diagonal(damping * diagonal) if damping else now.matrix
        eliminated = _ridged(damped, n_parameters).eliminated()
        halves, right = eliminated.right(now.score)
        left, side = eliminated.left, eliminated.left[n_parameters:, moduli]
        followed = _solve(left[n_parameters:, n_parameters:], np.column_stack([side, right[n_parameters:]]))
        slopes, rest = followed[:, :-1], followed[:, -1]
        matrix, score = left[np.ix_(moduli, moduli)] - side.T @ slopes, right[moduli] - side.T @ rest
        return cls(free, eliminated, halves, matrix, score, diagonal[moduli], slopes, rest)

    def step(self, radius: float = np.inf) -> NDArray[np.float64]:
        """Step (n,) to its minimum, or one whose log-moduli stay within the radius, by a ridge on these."""
        weight = 0.0
        for _ in range(60):
            theta = -_solve(self.matrix + weight * np.diag(self.diagonal), self.score[:, None])[:, 0]
            if np.abs(theta).max(initial=0.0) <= radius * 1.01:
                break
            weight = max(2.0 * weight, 0.05)
        shared = np.zeros(len(self.eliminated.left))
        shared[self.free[self.eliminated.places.shared]] = np.concatenate([theta, -self.rest - self.slopes @ theta])
        return self.eliminated.followed([-half for half in self.halves], shared)


def _ridged(matrix: Arrowhead, first: int) -> Arrowhead:
    """The same with a ridge on its unknowns from the `first` on."""
    ridge = RIDGE * np.maximum(matrix.diagonal, 1e-30)
    ridge[:first] = 0.0
    return matrix.plus_diagonal(ridge)


def _solve(matrix: NDArray[np.float64], rhs: NDArray[np.float64]) -> NDArray[np.float64]:
    """Solve a positive semi-definite system (n, n) scaled to a unit diagonal for rhs (n, k), with a ridge."""
    scale = 1.0 / np.sqrt(np.maximum(np.diag(matrix), 1e-30))[:, None]
    scaled = scale * matrix * scale.T
    scaled[np.diag_indices_from(scaled)] += RIDGE
    return np.asarray(scale * np.linalg.solve(scaled, scale * rhs))
