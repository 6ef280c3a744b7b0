"""Solutions with a factor, all right-hand sides at once."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from palpate.mechanics.solvers.multifrontal import dense
from palpate.mechanics.solvers.multifrontal.dense import Matrix
from palpate.mechanics.solvers.multifrontal.plan import Plan

__all__ = ["substituted"]


def substituted(plan: Plan, factor: Matrix, rhs: NDArray[np.float64]) -> Matrix:
    """X (n, m) of L L^T X = rhs (n, m), in the type of the factor."""
    x = rhs[plan.order].astype(factor.dtype, copy=False)
    transposed = x.T
    panels = [factor[f.panel : f.panel + f.size * f.width].reshape(f.width, f.size).T for f in plan.fronts]
    buffer = np.empty(max(len(f.rows) for f in plan.fronts) * x.shape[1], factor.dtype)
    for front, panel in zip(plan.fronts, panels, strict=True):
        w, m = front.width, len(front.rows)
        own = transposed[:, front.first : front.first + w]
        dense.solve_transposed(panel[:w], own)
        if m:
            change = buffer[: m * x.shape[1]].reshape(m, -1)
            dense.subtract_product(change.T, own, panel[w:], keep=0.0)
            x[front.rows] += change
    for front, panel in zip(plan.fronts[::-1], panels[::-1], strict=True):
        w, m = front.width, len(front.rows)
        own = transposed[:, front.first : front.first + w]
        if m:
            above = x[front.rows]
            dense.subtract_product(own, above.T, panel[w:], transposed=False)
        dense.solve_right(panel[:w], own)
    result = np.empty_like(x)
    result[plan.order] = x
    return result


def substituted_vector(plan: Plan, factor: Matrix, rhs: NDArray[np.float64]) -> Matrix:
    """x (n,) of L L^T x = rhs (n,), in the type of the factor."""
    x = rhs[plan.order].astype(factor.dtype, copy=False)
    panels = [factor[f.panel : f.panel + f.size * f.width].reshape(f.width, f.size).T for f in plan.fronts]
    for front, panel in zip(plan.fronts, panels, strict=True):
        w = front.width
        own = x[front.first : front.first + w]
        dense.solve_vector(panel[:w], own, transposed=False)
        if len(front.rows):
            below = x[front.rows]
            dense.subtract_from_vector(below, panel[w:], own, transposed=False)
            x[front.rows] = below
    for front, panel in zip(plan.fronts[::-1], panels[::-1], strict=True):
        w = front.width
        own = x[front.first : front.first + w]
        if len(front.rows):
            dense.subtract_from_vector(own, panel[w:], x[front.rows], transposed=True)
        dense.solve_vector(panel[:w], own, transposed=True)
    result = np.empty_like(x)
    result[plan.order] = x
    return result
