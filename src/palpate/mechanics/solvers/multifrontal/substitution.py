"""Solutions with a factor: subtrees side by side, each for all right-hand sides; above them each thread has its own.

A factor is read from memory once, then, by however many threads: for few right-hand sides that is all that counts.
"""

from __future__ import annotations

from collections.abc import Iterable
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from palpate.mechanics.solvers.multifrontal import dense
from palpate.mechanics.solvers.multifrontal.dense import Matrix
from palpate.mechanics.solvers.multifrontal.plan import Front, Plan, panel_of
from palpate.parallel import pool_of

__all__ = ["substituted"]

FEW = 6  # right-hand sides of a thread up to which a large front, once in the cache, is best met by one at a time
WIDE = 96  # columns of such a front
LARGEST_BLOCK = 64  # right-hand sides of a thread; more at once are not faster and take more memory


def substituted(plan: Plan, factor: Matrix, rhs: NDArray[np.float64], threads: int) -> NDArray[Any]:
    """X (n, m) of L L^T X = rhs (n, m), in the type of the factor."""
    m = rhs.shape[1]
    result = np.empty(rhs.shape, factor.dtype)
    ends = np.linspace(0, m, max(-(-m // (LARGEST_BLOCK * threads)), 1) + 1).astype(int).tolist()
    for begin, end in pairwise(ends):
        x = np.ascontiguousarray(rhs[plan.order, begin:end], dtype=factor.dtype)
        if threads == 1:
            _forward(plan.fronts, factor, x)
            _backward(plan.fronts, factor, x)
        else:
            _side_by_side(plan, factor, x, threads)
        result[plan.order, begin:end] = x
    return result


def _side_by_side(plan: Plan, factor: Matrix, x: Matrix, threads: int) -> None:
    """L^-T L^-1 X in place of X (n, m), rows in the order of elimination."""
    subtrees = [plan.fronts[subtree.start : subtree.stop] for step in plan.steps for subtree in step.subtrees]
    above = [plan.fronts[s] for step in plan.steps for s in step.then]
    ends = np.linspace(0, x.shape[1], min(threads, x.shape[1]) + 1).astype(int).tolist()

    def up(subtree: tuple[Front, ...]) -> tuple[NDArray[np.int64], Matrix]:
        """The subtree's own rows in their place; what it changes above (its root's rows), and by how much."""
        own, root = slice(subtree[0].first, subtree[-1].first + subtree[-1].width), subtree[-1]
        alone = np.zeros(x.shape, x.dtype)  # only the pages that are written are ever taken
        alone[own] = x[own]
        _forward(subtree, factor, alone)
        x[own] = alone[own]
        return root.rows, alone[root.rows]

    def over(columns: tuple[int, int]) -> None:
        """The fronts above all subtrees, for some of the right-hand sides."""
        part = x[:, slice(*columns)]
        _forward(above, factor, part)
        _backward(above, factor, part)

    with pool_of(threads) as pool:
        for rows, change in pool.map(up, subtrees):
            x[rows] += change
        list(pool.map(over, pairwise(ends)))
        list(pool.map(lambda subtree: _backward(subtree, factor, x), subtrees))


def _forward(fronts: Iterable[Front], factor: Matrix, x: Matrix) -> None:
    """What L^-1 does to X (n, m) by these fronts, children before their parents."""
    for front in fronts:
        panel, own = panel_of(factor, front), x[front.first : front.first + front.width]
        triangle, rest, m = panel[: front.width], panel[front.width :], x.shape[1]
        if m == 1 or (m <= FEW and front.width >= WIDE):
            columns, change = np.asfortranarray(own), np.zeros((len(rest), m), x.dtype, order="F")
            for k in range(m):
                dense.solve_vector(triangle, columns[:, k], transposed=False)
                if len(rest):
                    dense.subtract_from_vector(change[:, k], rest, columns[:, k], transposed=False)
            own[:] = columns
        else:
            dense.solve_transposed(triangle, own.T)
            change = np.empty((len(rest), m), x.dtype)
            if len(rest):
                dense.subtract_product(change.T, own.T, rest, keep=0.0)
        x[front.rows] += change


def _backward(fronts: Iterable[Front], factor: Matrix, x: Matrix) -> None:
    """What L^-T does to X (n, m) by these fronts, parents before their children."""
    for front in reversed(tuple(fronts)):
        panel, own = panel_of(factor, front), x[front.first : front.first + front.width]
        triangle, rest, m = panel[: front.width], panel[front.width :], x.shape[1]
        if m == 1 or (m <= FEW and front.width >= WIDE):
            columns, below = np.asfortranarray(own), np.asfortranarray(x[front.rows])
            for k in range(m):
                if len(rest):
                    dense.subtract_from_vector(columns[:, k], rest, below[:, k], transposed=True)
                dense.solve_vector(triangle, columns[:, k], transposed=True)
            own[:] = columns
        else:
            if len(rest):
                dense.subtract_product(own.T, x[front.rows].T, rest, transposed=False)
            dense.solve_right(triangle, own.T)
