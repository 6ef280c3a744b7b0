"""Newton's method along a path: from any displacement to equilibrium, in steps as long as the elements bear.

A start u_0 that is not in equilibrium is led there by a homotopy in s from 0 to 1: the boundary moves by
g(s) = g_0 + s (g_1 - g_0), and the out-of-balance forces fade, F^T R(u) = (1 - s) F^T R(u_0). Each step begins with a
predictor in which **the boundary's increment enters through the tangent**,

    F^T K F dz = -(F^T R(u) - (1 - s - ds) F^T R(u_0)) - ds F^T K (g_1 - g_0),     du = F dz + ds (g_1 - g_0)

(moving the boundary alone first would invert the elements beside it), shortened until no element comes near J = 0, and
is corrected by Newton's method with a line search on du . R (Bathe, Finite Element Procedures, 2014, section 8.4;
Crisfield, vol. 1, 1991, section 9.4). A factorisation costs as much as thirty solutions, so an old one preconditions
conjugate gradients with the new tangent for as long as few steps of them do (inexact Newton; Dembo, Eisenstat &
Steihaug, SIAM J. Numer. Anal. 19 (1982) 400-408). At the end of the way an old tangent serves once more if
that ends it, taking as large a share off the residual as before (modified Newton; Bathe, section 8.4.1).

Nearly incompressible elements would answer the second-order volume error of a step with a pressure that makes the
tangent indefinite. So the tangent takes the pressures that the last linear solve foresaw: Newton's method for the mixed
problem in displacements and element pressures, the pressures eliminated (Simo, Taylor & Pister, CMAME 51 (1985)
177-208).
"""

from __future__ import annotations

import contextlib
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from palpate.errors import SolverError
from palpate.mechanics.balance import TissueBalance
from palpate.mechanics.forward import SolveCounts
from palpate.mechanics.pattern import Stiffness
from palpate.mechanics.solvers.conjugate_gradients import conjugate_gradients, times
from palpate.mechanics.solvers.contract import Factorisation

Array = NDArray[np.float64]

KEPT_VOLUME = 0.1  # of the smallest J (volume ratio) before a step, below which no step may lead
FORCING = (1e-3, 3e-2)  # least and largest relative residual of a correction by conjugate gradients
MAX_GRADIENTS = 18  # conjugate gradient steps, after which a new factorisation is cheaper
SEARCHES = 8  # trials of a line search
EASY = 4  # iterations: after a step that needs no more, the next one is twice as long


@dataclass(frozen=True, slots=True)
class NewtonSettings:
    """When to stop: tolerances of |F^T R| over the largest |internal forces| (final, between steps), counts, step.

    solver: a name of `palpate.mechanics.solvers.registry.SOLVERS` or "auto".
    """

    tolerance: float = 1e-9
    step_tolerance: float = 1e-3
    max_iterations: int = 25
    max_steps: int = 60
    smallest_step: float = 1.0 / 256.0
    solver: str = "auto"


@dataclass(frozen=True, slots=True)
class NewtonPath:
    """Where a path has got: displacement (n_dof,) mm at `fraction` s of the way; converged means s = 1 and balanced.

    reason: a sentence; steps, iterations (linear solves) and counts so far; factorisation: the last one;
    force: largest length of the internal forces so far, mN; exact: whether the factorisation is of this very place;
    pressure: mean pressure (n_cells,) kPa of each element that the last linear solve foresaw.
    """

    displacement: Array
    fraction: float
    converged: bool
    reason: str
    steps: int
    iterations: int
    counts: SolveCounts
    factorisation: Factorisation | None
    force: float
    exact: bool = False
    pressure: Array | None = None

    def with_factorisation(self, factorisation: Factorisation) -> NewtonPath:
        """The path with a new factorisation, which is counted."""
        counts = self.counts + SolveCounts(factorisations=1)
        return replace(self, factorisation=factorisation, counts=counts)

    def moved(self, balance: TissueBalance, change: Array, share: float) -> NewtonPath:
        """A share of `change` (n_dof,) mm further, pressures foreseen along with the displacement."""
        now = balance.pressure_ahead(self.displacement, 0.0 * change) if self.pressure is None else self.pressure
        ahead = balance.pressure_ahead(self.displacement, change)
        displacement, pressure = self.displacement + share * change, now + share * (ahead - now)
        return replace(self, displacement=displacement, pressure=pressure)

    def solved(self, n: int) -> NewtonPath:
        """One more iteration, for which n solutions were needed."""
        return replace(self, iterations=self.iterations + 1, counts=self.counts + SolveCounts(forward=n))


class _StepFailed(Exception):  # noqa: N818 - never leaves this module
    """A step failed; the text says why, and `counts` what it cost."""

    def __init__(self, reason: str, path: NewtonPath) -> None:
        super().__init__(reason)
        self.path = path


@dataclass(frozen=True, slots=True)
class _Way:
    """The homotopy: the whole boundary increment (n_dof,) mm and the start's out-of-balance forces (n_free,) mN."""

    balance: TissueBalance
    settings: NewtonSettings
    increment: Array
    unbalanced: Array

    def residual(self, displacement: Array, fraction: float) -> tuple[Array, float]:
        """F^T R(u) - (1 - s) F^T R(u_0) (n_free,), and the length of the internal forces."""
        forces, size = self.balance.residual(displacement)
        return np.asarray(self.balance.free.T @ forces) - (1.0 - fraction) * self.unbalanced, size


def follow(
    balance: TissueBalance, start: Array, increment: Array, *, settings: NewtonSettings, nearby: Factorisation | None
) -> NewtonPath:
    """Lead the displacement `start` (n_dof,) mm to equilibrium while the boundary moves by `increment` (n_dof,) mm.

    nearby: a factorisation of a stiffness like that of the start, if there is one. Never raises for lack of
    convergence: the path then ends, not converged, at the last state that was balanced.
    """
    with np.errstate(invalid="ignore", divide="ignore", over="ignore"):
        forces, size = balance.residual(start)
        way = _Way(balance, settings, increment, np.asarray(balance.free.T @ forces))
        path = NewtonPath(start, 0.0, False, "", 0, 0, SolveCounts(), nearby, max(size, float(np.finfo(float).tiny)))
        length, failure = 1.0, ""
        while path.fraction < 1.0:
            if length < settings.smallest_step or path.steps >= settings.max_steps:
                reason = (
                    f"no equilibrium was found beyond {100.0 * path.fraction:.1f} % of the motion and load (step"
                    f" {path.steps}): {failure or f'{path.steps} steps were not enough'}; move or load the body less,"
                    " or use a finer mesh where it moves most"
                )
                return replace(path, reason=reason)
            before = path
            try:
                path = _step(way, path, min(length, 1.0 - path.fraction))
            except _StepFailed as stop:
                failure = str(stop)
                path = replace(before, steps=before.steps + 1, iterations=stop.path.iterations, counts=stop.path.counts)
                length = 0.25 * length
                continue
            taken = path.fraction - before.fraction
            length = 2.0 * taken if path.iterations - before.iterations <= EASY else taken
    return replace(path, converged=True, reason=f"in equilibrium after {path.iterations} iterations")


def _step(way: _Way, path: NewtonPath, length: float) -> NewtonPath:
    """Predictor, shortened if need be, and Newton's iterations until the residual is below the tolerance."""
    balance, settings, fraction = way.balance, way.settings, path.fraction
    residual, _ = way.residual(path.displacement, fraction + length)
    stiffness = balance.stiffness(path.displacement, path.pressure)
    load = residual + length * np.asarray(balance.free.T @ (stiffness @ way.increment))
    forcing = float(np.clip(0.3 * _tolerance(way, fraction + length), *FORCING))
    free, path = _solved(way, path, stiffness, -load, forcing)
    change = np.asarray(balance.free @ free) + length * way.increment
    share = _bearable(way, path, change)
    ahead = min(1.0, fraction + share * length)
    ahead = 1.0 if 1.0 - ahead < 1e-12 else ahead
    path = replace(path.moved(balance, change, share), fraction=ahead, steps=path.steps + 1)
    tolerance = _tolerance(way, ahead)
    residual, size = way.residual(path.displacement, ahead)
    before = float(np.linalg.norm(load))
    for _ in range(settings.max_iterations):
        path = replace(path, force=max(path.force, size))
        norm = float(np.linalg.norm(residual))
        if norm <= tolerance * path.force:
            return path
        # The correction is solved as exactly as the next residual deserves, and no more exactly than the tolerance.
        forcing = max(float(np.clip(norm / path.force, *FORCING)), 0.3 * tolerance * path.force / norm)
        if ahead < 1.0 or norm / before > tolerance * path.force / norm:  # a step would go on from pressures of before
            stiffness = balance.stiffness(path.displacement, path.pressure)
        before = norm
        free, path = _solved(way, path, stiffness, -residual, forcing)
        path, residual, size = _search(way, path, residual, np.asarray(balance.free @ free))
    share = float(np.linalg.norm(residual)) / path.force
    raise _StepFailed(
        f"{settings.max_iterations} Newton iterations left out-of-balance forces of {share:.1g} of the internal ones,"
        f" with {balance.weakest(path.displacement)} the worst",
        path,
    )


def _bearable(way: _Way, path: NewtonPath, change: Array) -> float:
    """Largest share 1, 1/2, 1/4 ... of `change` after which every element keeps a tenth of the smallest J before."""
    least = KEPT_VOLUME * way.balance.smallest_volume(path.displacement)
    for share in 0.5 ** np.arange(SEARCHES):
        if way.balance.smallest_volume(path.displacement + share * change) >= least:
            return float(share)
    worst = way.balance.weakest(path.displacement + 0.5**SEARCHES * change)
    raise _StepFailed(f"{worst} would be turned inside out", path)


def _tolerance(way: _Way, fraction: float) -> float:
    """The final tolerance at the end of the homotopy, and a looser one between its steps."""
    return way.settings.tolerance if fraction == 1.0 else way.settings.step_tolerance


def _solved(way: _Way, path: NewtonPath, stiffness: Stiffness, load: Array, forcing: float) -> tuple[Array, NewtonPath]:
    """Free displacements (n_free,) under `load` (n_free,), by the old factorisation where it is near enough.

    `forcing` is the relative residual that is good enough.
    """
    balance, column = way.balance, load[:, None]
    try:
        if path.factorisation is not None and balance.symmetric:
            product, nearby = partial(times, balance.restricted(stiffness)), path.factorisation.nearly
            with contextlib.suppress(SolverError):
                free, n = conjugate_gradients(product, column, nearby, tolerance=forcing, max_iterations=MAX_GRADIENTS)
                return free[:, 0], path.solved(n)
            path = replace(path, counts=path.counts + SolveCounts(forward=MAX_GRADIENTS))
        path = path.with_factorisation(balance.factorise(stiffness))
        assert path.factorisation is not None
        return path.factorisation.solve(column)[:, 0], path.solved(1)
    except SolverError as error:
        raise _StepFailed(f"the tangent stiffness cannot be solved with ({error})", path) from error


def _search(way: _Way, path: NewtonPath, residual: Array, change: Array) -> tuple[NewtonPath, Array, float]:
    """Line search along a Newton direction: |du . R| must fall, or the residual's length."""
    share = _bearable(way, path, change)
    along = np.asarray(way.balance.free.T @ change)
    slope, norm = float(along @ residual), float(np.linalg.norm(residual))
    for _ in range(SEARCHES):
        ahead = path.displacement + share * change
        after, size = way.residual(ahead, path.fraction)
        here = float(along @ after)
        if abs(here) <= 0.8 * abs(slope) or float(np.linalg.norm(after)) < norm:
            return path.moved(way.balance, change, share), after, size
        root = slope / (slope - here) if np.isfinite(here) and here != slope else 0.5
        share *= float(np.clip(root, 0.1, 0.5))
    raise _StepFailed(
        f"no step along Newton's direction lowers the out-of-balance forces, with"
        f" {way.balance.weakest(path.displacement)} the worst",
        path,
    )
