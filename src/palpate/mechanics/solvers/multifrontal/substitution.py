"""Solutions with a factor: many right-hand sides in blocks, by several threads; few one by one."""

from __future__ import annotations

from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from palpate.mechanics.solvers.multifrontal import dense
from palpate.mechanics.solvers.multifrontal.dense import Matrix
from palpate.mechanics.solvers.multifrontal.plan import Plan, panel_of
from palpate.parallel import pool_of

__all__ = ["substituted"]

FEW = 2  # right-hand sides up to which one after the other is faster than a block
LARGEST_BLOCK = 64  # of them; larger ones are not faster and take more memory


def substituted(plan: Plan, factor: Matrix, rhs: NDArray[np.float64], threads: int) -> NDArray[Any]:
    """X (n, m) of L L^T X = rhs (n, m), in the type of the factor."""
    n, m = rhs.shape
    result = np.empty((n, m), factor.dtype)
    blocks = max(-(-m // LARGEST_BLOCK), min(threads, m))
    bounds = np.linspace(0, m, blocks + 1).astype(int).tolist()

    def solve(begin: int, end: int) -> None:
        """Columns begin to end."""
        x = np.ascontiguousarray(rhs[plan.order, begin:end], dtype=factor.dtype)
        if end - begin <= FEW:
            for column in range(end - begin):
                vector = np.ascontiguousarray(x[:, column])
                _forward_and_back(plan, factor, vector)
                x[:, column] = vector
        else:
            _block_forward_and_back(plan, factor, x)
        result[plan.order, begin:end] = x

    if threads == 1 or blocks == 1:
        for begin, end in pairwise(bounds):
            solve(begin, end)
    else:
        with pool_of(threads) as pool:
            list(pool.map(solve, bounds[:-1], bounds[1:]))
    return result


def _block_forward_and_back(plan: Plan, factor: Matrix, x: Matrix) -> None:
    """L^-T L^-1 X in place of X (n, m), rows in the order of elimination."""
    across = x.T
    buffer = np.empty(max(len(front.rows) for front in plan.fronts) * x.shape[1], factor.dtype)
    for front in plan.fronts:
        panel, w, own = panel_of(factor, front), front.width, across[:, front.first : front.first + front.width]
        dense.solve_transposed(panel[:w], own)
        if len(front.rows):
            change = buffer[: len(front.rows) * x.shape[1]].reshape(len(front.rows), -1)
            dense.subtract_product(change.T, own, panel[w:], keep=0.0)
            x[front.rows] += change
    for front in reversed(plan.fronts):
        panel, w, own = panel_of(factor, front), front.width, across[:, front.first : front.first + front.width]
        if len(front.rows):
            dense.subtract_product(own, x[front.rows].T, panel[w:], transposed=False)
        dense.solve_right(panel[:w], own)


def _forward_and_back(plan: Plan, factor: Matrix, x: Matrix) -> None:
    """L^-T L^-1 x in place of x (n,), in the order of elimination."""
    for front in plan.fronts:
        panel, w, own = panel_of(factor, front), front.width, x[front.first : front.first + front.width]
        dense.solve_vector(panel[:w], own, transposed=False)
        if len(front.rows):
            below = x[front.rows]
            dense.subtract_from_vector(below, panel[w:], own, transposed=False)
            x[front.rows] = below
    for front in reversed(plan.fronts):
        panel, w, own = panel_of(factor, front), front.width, x[front.first : front.first + front.width]
        if len(front.rows):
            dense.subtract_from_vector(own, panel[w:], x[front.rows], transposed=True)
        dense.solve_vector(panel[:w], own, transposed=True)
