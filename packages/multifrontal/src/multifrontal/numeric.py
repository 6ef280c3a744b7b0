"""The factor's numbers, and solutions with them: fronts one after the other, subtrees of them side by side.

A solution reads the factor from memory once a way, by however many threads, and what surrounds its calls on small
fronts takes as long as these: for few right-hand sides threads would wait for Python's lock, and products by NumPy cost
least. So subtrees are met by all right-hand sides at once, and the fronts above by each thread with its own.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from multifrontal import dense
from multifrontal.dense import Matrix, pool_of
from multifrontal.plan import Front, Plan, blocks_of, panel_of

__all__ = ["NotPositiveDefinite", "factorised", "substituted"]

BLOCK = 256  # columns of a large front that are eliminated before the others hear of them
Everywhere = Callable[[Callable[[Any], None], Iterable[Any]], None]
FEW = 3  # right-hand sides up to which one at a time is fastest: the products of several have no kernel for so few
SHARED = 48  # right-hand sides from which on threads share the fronts: for fewer it takes as long
ROWS = 2048  # of right-hand sides that are put in order while they lie in the cache
LARGEST_BLOCK = 64  # right-hand sides of a thread; more at once are not faster and take more memory


class NotPositiveDefinite(np.linalg.LinAlgError):
    """A pivot is not positive: the `pivot`-th of elimination, from 1 on, of a matrix of `n` unknowns."""

    def __init__(self, n: int, pivot: int) -> None:
        self.n, self.pivot = n, pivot
        super().__init__(f"the matrix of {n} unknowns is not positive definite: pivot {pivot} of elimination is not")


@dataclass(frozen=True, slots=True)
class _Work:
    """A factorisation under way: the matrix' entries (nnz,), the factor and the working memory."""

    plan: Plan
    data: NDArray[np.float64]
    factor: Matrix
    memory: Matrix


def factorised(plan: Plan, data: NDArray[np.float64], dtype: type) -> Matrix:
    """The factor's columns, one front's after the other, of the matrix with the plan's pattern and entries (nnz,).

    Raises `NotPositiveDefinite`.
    """
    work, threads = _Work(plan, data, np.zeros(plan.factor_size, dtype), np.zeros(plan.work_size, dtype)), plan.threads
    if threads == 1:
        for step in plan.steps:
            for subtree in step.subtrees:
                _eliminate_subtree(work, subtree)
            for s in step.then:
                _eliminate(work, plan.fronts[s])
        return work.factor
    with pool_of(threads) as pool:

        def everywhere(function: Callable[[Any], None], items: Iterable[Any]) -> None:
            """All calls done, by all threads."""
            list(pool.map(function, items))

        for step in plan.steps:
            everywhere(lambda subtree: _eliminate_subtree(work, subtree), step.subtrees)
            for s in step.then:
                _eliminate_large(work, plan.fronts[s], threads, everywhere)
    return work.factor


def _eliminate_subtree(work: _Work, subtree: range) -> None:
    for s in subtree:
        _eliminate(work, work.plan.fronts[s])


def _eliminate(work: _Work, front: Front) -> None:
    """One front by one thread."""
    panel, w = _assembled(work, front), front.width
    _add_children(work, front, panel, (0, w))
    _check(work, front, dense.factor(panel[:w]))
    if len(front.rows):
        dense.solve_transposed(panel[:w], panel[w:])
    for low, high, block in blocks_of(work.memory, front):
        _update(block, panel[w + low :], high - low, 0.0)
        _add_children(work, front, block, (w + low, w + high))


def _eliminate_large(work: _Work, front: Front, threads: int, everywhere: Everywhere) -> None:
    """One front by all threads."""
    panel, w = _assembled(work, front), front.width

    def add(part: tuple[int, int]) -> None:
        _add_children(work, front, panel[part[0] :, part[0] : part[1]], part)

    def remainder(block: tuple[int, int, Matrix]) -> None:
        low, high, matrix = block
        _update(matrix, panel[w + low :], high - low, 0.0)
        _add_children(work, front, matrix, (w + low, w + high))

    everywhere(add, _parts(0, w, front.size, threads))
    for begin in range(0, w, BLOCK):
        pivot = _eliminate_columns(panel, begin, min(begin + BLOCK, w), threads, everywhere)
        _check(work, front, pivot, begin)
    everywhere(remainder, blocks_of(work.memory, front))


def _eliminate_columns(panel: Matrix, begin: int, end: int, threads: int, everywhere: Everywhere) -> int:
    """Columns begin to end of a front (size, width), of which those right of them then hear; as `dense.factor`."""
    pivot, done, (size, width) = panel[begin:end, begin:end], panel[:, begin:end], panel.shape
    failed = dense.factor(pivot)
    if failed:
        return failed
    rows = pairwise(np.linspace(end, size, threads + 1).astype(int).tolist())
    everywhere(lambda part: dense.solve_transposed(pivot, done[slice(*part)]), rows)
    parts = _parts(end, width, size, threads)
    everywhere(lambda part: _update(panel[part[0] :, slice(*part)], done[part[0] :], part[1] - part[0], 1.0), parts)
    return 0


def _update(matrix: Matrix, done: Matrix, width: int, keep: float) -> None:
    """Keep C - D D_1^T in place of C (n, width) from its diagonal on; D (n, k), D_1 its first `width` rows."""
    dense.subtract_square(matrix[:width], done[:width], keep=keep)
    if width < len(done):
        dense.subtract_product(matrix[width:], done[width:], done[:width], keep=keep)


def _parts(low: int, high: int, size: int, threads: int) -> list[tuple[int, int]]:
    """Columns low to high in as many ranges as there are threads, of equal area below the diagonal of `size` rows."""
    if high - low < 2 * threads:
        return [(low, high)] if high > low else []
    area = np.cumsum(size - np.arange(low, high))
    bounds = np.searchsorted(area, area[-1] * np.arange(1, threads) / threads)
    ends = [low, *(low + bounds).tolist(), high]
    return [(a, b) for a, b in pairwise(ends) if b > a]


def _assembled(work: _Work, front: Front) -> Matrix:
    """The front's columns with the matrix' entries alone."""
    panel = panel_of(work.factor, front)
    plan, entries = work.plan, front.entries
    flat = work.factor[front.panel : front.panel + front.size * front.width]
    flat[plan.target[entries]] = work.data[plan.source[entries]]
    return panel


def _add_children(work: _Work, front: Front, matrix: Matrix, columns: tuple[int, int]) -> None:
    """Add what a front's children contribute to its columns (first, last), from the diagonal on."""
    for number in front.children:
        child = work.plan.fronts[number]
        for low, high, block in blocks_of(work.memory, child):
            _add(matrix, columns, block, (low, high), child.runs)


def _add(
    matrix: Matrix,
    columns: tuple[int, int],
    block: Matrix,
    own: tuple[int, int],
    runs: tuple[tuple[int, int, int], ...],
) -> None:
    """Add columns `own` of a contribution to those among `columns` of a front, run by run; all from the diagonal on."""
    for number, (start, there, length) in enumerate(runs):
        ahead = there - start
        begin = max(start, own[0], columns[0] - ahead)
        end = min(start + length, own[1], columns[1] - ahead)
        if begin >= end:
            continue
        target = matrix[:, begin + ahead - columns[0] : end + ahead - columns[0]]
        source = block[:, begin - own[0] : end - own[0]]
        for row, row_there, count in runs[number:]:
            first = max(row, begin)
            place = row_there + first - row - columns[0]
            part = target[place : place + row + count - first]
            np.add(part, source[first - own[0] : row + count - own[0]], out=part)


def _check(work: _Work, front: Front, pivot: int, before: int = 0) -> None:
    if pivot:
        raise NotPositiveDefinite(len(work.plan.order), front.first + before + pivot)


def substituted(plan: Plan, factor: Matrix, rhs: NDArray[np.float64], *, scale: float = 1.0) -> NDArray[np.float64]:
    """X (n, m) of L L^T X = rhs (n, m) / scale, computed in the type of the factor.

    In single precision, which has a small range, each right-hand side is brought to the size 1 meanwhile.
    """
    n, m, threads = *rhs.shape, plan.threads
    result, parts = np.empty(rhs.shape), [slice(start, start + ROWS) for start in range(0, n, ROWS)]
    ends = np.linspace(0, m, max(-(-m // (LARGEST_BLOCK * threads)), 1) + 1).astype(int).tolist()
    for begin, end in pairwise(ends):
        sizes = np.ones(end - begin)
        if factor.dtype == np.float32:
            sizes = np.max([np.abs(rhs[part, begin:end]).max(axis=0) for part in parts], axis=0, initial=0.0)
            sizes = np.maximum(sizes, np.finfo(np.float64).tiny)
        x = np.empty((n, end - begin), factor.dtype)
        for some in parts:  # what is put in order stays in the cache until it is scaled
            x[some] = rhs[plan.order[some], begin:end] / sizes
        if end - begin <= FEW:
            _one_by_one(plan, factor, x)
        elif threads == 1 or end - begin < SHARED:
            _forward(plan.fronts, factor, x)
            _backward(plan.fronts, factor, x)
        else:
            _side_by_side(plan, factor, x)
        for some in parts:
            result[plan.order[some], begin:end] = x[some] * (sizes / scale)
    return result


def _one_by_one(plan: Plan, factor: Matrix, x: Matrix) -> None:
    """L^-T L^-1 X in place of X (n, m) of few right-hand sides, in the order of elimination, by one thread."""
    above = np.empty(max(len(front.rows) for front in plan.fronts), x.dtype)
    for column in x.T:
        single = np.ascontiguousarray(column)
        places = dense.address(factor), dense.address(single), dense.address(above)
        one = _One(dense.Vectors.of(factor.dtype), single, above, factor.itemsize, *places)
        for front in plan.fronts:
            one.forward(front)
        for front in reversed(plan.fronts):
            one.backward(front)
        column[:] = single


@dataclass(frozen=True, slots=True)
class _One:
    """One right-hand side x (n,), met by a front after the other.

    above (n_rows,): what a front does to its rows, or has of them; at_factor, at_x, at_above: where the first of their
    numbers lie, of `item` bytes each.
    """

    vectors: dense.Vectors
    x: Matrix
    above: Matrix
    item: int
    at_factor: int
    at_x: int
    at_above: int

    def forward(self, front: Front) -> None:
        """What L^-1 does by this front."""
        size, width, below, corner, own = self._places(front)
        self.vectors.solve(False, width, corner, size, own)
        if below:
            rows = corner + self.item * width
            self.vectors.subtract(False, (below, width), rows, size, own, self.at_above, keep=False)
            self.x[front.rows] += self.above[:below]

    def backward(self, front: Front) -> None:
        """What L^-T does by this front."""
        size, width, below, corner, own = self._places(front)
        if below:
            self.above[:below] = self.x[front.rows]
            rows = corner + self.item * width
            self.vectors.subtract(True, (below, width), rows, size, self.at_above, own, keep=True)
        self.vectors.solve(True, width, corner, size, own)

    def _places(self, front: Front) -> tuple[int, int, int, int, int]:
        """Rows and columns of a front, its rows below them, where its columns and its own part of x begin."""
        corner, own = self.at_factor + self.item * front.panel, self.at_x + self.item * front.first
        return front.size, front.width, len(front.rows), corner, own


def _side_by_side(plan: Plan, factor: Matrix, x: Matrix) -> None:
    """L^-T L^-1 X in place of X (n, m), rows in the order of elimination, subtrees side by side."""
    subtrees = [plan.fronts[subtree.start : subtree.stop] for step in plan.steps for subtree in step.subtrees]
    above = [plan.fronts[s] for step in plan.steps for s in step.then]
    ends = np.linspace(0, x.shape[1], min(plan.threads, x.shape[1]) + 1).astype(int).tolist()

    def up(subtree: tuple[Front, ...]) -> tuple[NDArray[np.int64], Matrix]:
        """The subtree's own rows in their place; what it changes above (its root's rows), and by how much."""
        root = subtree[-1]
        begin, end = subtree[0].first, root.first + root.width
        alone = np.concatenate([x[begin:end], np.zeros((len(root.rows), x.shape[1]), x.dtype)])
        _forward([_within(front, begin, end, root.rows) for front in subtree], factor, alone)
        x[begin:end] = alone[: end - begin]
        return root.rows, alone[end - begin :]

    def over(columns: tuple[int, int]) -> None:
        """The fronts above all subtrees, for some of the right-hand sides."""
        part = np.ascontiguousarray(x[:, slice(*columns)])
        _forward(above, factor, part)
        _backward(above, factor, part)
        x[:, slice(*columns)] = part

    with pool_of(plan.threads) as pool:
        for rows, change in pool.map(up, subtrees):
            x[rows] += change
        list(pool.map(over, pairwise(ends)))
        list(pool.map(lambda subtree: _backward(subtree, factor, x), subtrees))


def _within(front: Front, begin: int, end: int, rows: NDArray[np.int64]) -> Front:
    """A front of a subtree with unknowns `begin` to `end`, which come first, before those at `rows` above it."""
    above = np.searchsorted(rows, front.rows) + end - begin
    return replace(front, first=front.first - begin, rows=np.where(front.rows < end, front.rows - begin, above))


def _forward(fronts: Iterable[Front], factor: Matrix, x: Matrix) -> None:
    """What L^-1 does to X (n, m), its rows contiguous, by these fronts, children before their parents."""
    whole_rows = x.view(np.dtype((np.void, x.itemsize * x.shape[1])))[:, 0]
    for front in fronts:
        panel, own = panel_of(factor, front), x[front.first : front.first + front.width]
        dense.solve_transposed(panel[: front.width], own.T)
        if len(front.rows):
            above = x.take(front.rows, axis=0)  # x[rows] takes four times as long
            above -= panel[front.width :] @ own
            whole_rows.put(front.rows, above.view(whole_rows.dtype))


def _backward(fronts: Iterable[Front], factor: Matrix, x: Matrix) -> None:
    """What L^-T does to X (n, m), its rows contiguous, by these fronts, parents before their children."""
    for front in reversed(tuple(fronts)):
        panel, own = panel_of(factor, front), x[front.first : front.first + front.width]
        if len(front.rows):
            own -= panel[front.width :].T @ x.take(front.rows, axis=0)
        dense.solve_right(panel[: front.width], own.T)
