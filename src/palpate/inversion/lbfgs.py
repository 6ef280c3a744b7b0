"""L-BFGS-B on the log-moduli, the paper's optimiser; the driver's motion is solved for at each of them."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy import optimize

from palpate.inversion.gauss_newton import Bounds, Iterate, Minimum, Outcome, gauss_newton
from palpate.inversion.objective import Objective

__all__ = ["lbfgs"]


def lbfgs(
    objective: Objective, start: NDArray[np.float64], *, bounds: Bounds, tolerance: float = 1e-4, max_steps: int = 60
) -> Minimum:
    """Minimise min_q J(theta, q) over theta from `start` (n_unknowns,) with L-BFGS-B (Byrd et al. 1995).

    Its gradient is dJ/dtheta at the best q (envelope theorem). It ends when the projected gradient, scaled by the
    curvature at the start, falls under the square root of `tolerance`.
    """
    n = objective.n_parameters
    inner = gauss_newton(objective, start, bounds=bounds, hold_theta=True, tolerance=tolerance)
    scale = 1.0 / np.sqrt(np.maximum(np.diag(inner.evaluation.matrix)[:n], 1e-30))
    best, history = inner, list[Iterate]()

    def reduced(scaled: NDArray[np.float64]) -> tuple[float, NDArray[np.float64]]:
        """min_q J and its slope (n_parameters,) by the scaled log-moduli (n_parameters,)."""
        nonlocal best
        unknowns = np.concatenate([scaled * scale, best.unknowns[n:]])
        best = gauss_newton(objective, unknowns, bounds=bounds, hold_theta=True, tolerance=tolerance)
        now = best.evaluation
        slope = now.gradient[:n] * scale
        history.append(Iterate(best.unknowns[:n], now.value, now.misfit_mm2, float(0.5 * slope @ slope)))
        return now.value, slope

    found = optimize.minimize(
        reduced,
        start[:n] / scale,
        jac=True,
        method="L-BFGS-B",
        bounds=optimize.Bounds(bounds.lower / scale, bounds.upper / scale),
        options={"maxiter": max_steps, "ftol": 1e-14, "gtol": float(np.sqrt(tolerance))},
    )
    reduced(found.x)
    small = history[-1].decrement < 100.0 * tolerance
    outcome = Outcome.CONVERGED if found.success else Outcome.STALLED if small else Outcome.STEPS
    return Minimum(best.unknowns, best.evaluation, outcome, tuple(history))
