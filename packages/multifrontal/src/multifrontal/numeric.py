"""The factor's numbers, and solutions with them: fronts one after the other, subtrees of them side by side.

A solution reads the factor from memory once a way, by however many threads: for few right-hand sides that is all that
counts. So subtrees are met by all right-hand sides at once, and the fronts above by each thread with its own.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
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
FEW = 6  # right-hand sides up to which one at a time is fastest: the products of several have no kernel for so few
CACHE = 1 << 19  # bytes of a front that are met by all of these while they lie in the cache
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
            x = _one_by_one(plan, factor, x)
        elif threads == 1:
            _forward(plan.fronts, factor, x)
            _backward(plan.fronts, factor, x)
        else:
            _side_by_side(plan, factor, x)
        for some in parts:
            result[plan.order[some], begin:end] = x[some] * (sizes / scale)
    return result


def _one_by_one(plan: Plan, factor: Matrix, rhs: Matrix) -> Matrix:
    """L^-T L^-1 rhs (n, m) of few right-hand sides, in the order of elimination, by one thread.

    Threads would wait for Python's lock longer than they compute.
    """
    x = np.ascontiguousarray(rhs.T)
    above = np.empty((len(x), max(len(front.rows) for front in plan.fronts)), x.dtype)
    places = tuple((dense.address(own), dense.address(rows)) for own, rows in zip(x, above, strict=True))
    few = _Few(dense.Vectors.of(factor.dtype), dense.address(factor), factor.itemsize, tuple(x), tuple(above), places)
    for front in plan.fronts:
        few.forward(front)
    for front in reversed(plan.fronts):
        few.backward(front)
    return x.T


@dataclass(frozen=True, slots=True)
class _Few:
    """Few right-hand sides x (m of (n,)), met by a front one at a time, in parts of it that the cache holds meanwhile.

    above (m of (n_rows,)): what a front does to its rows, or has of them; places: addresses of x and above; factor: of
    the factor, its numbers of `item` bytes.
    """

    vectors: dense.Vectors
    factor: int
    item: int
    x: tuple[Matrix, ...]
    above: tuple[Matrix, ...]
    places: tuple[tuple[int, int], ...]

    def forward(self, front: Front) -> None:
        """What L^-1 does by this front."""
        size, below = front.size, len(front.rows)
        for begin, end, corner in self._stretches(front):
            n, rest, ahead = end - begin, front.width - end, self.item * (end - begin)
            for own, change in self.places:
                here = own + self.item * (front.first + begin)
                self.vectors.solve(False, n, corner, size, here)
                if rest:
                    self.vectors.subtract(False, (rest, n), corner + ahead, size, here, here + ahead, keep=True)
                if below:
                    rows = corner + self.item * (front.width - begin)
                    self.vectors.subtract(False, (below, n), rows, size, here, change, keep=begin > 0)
        if below:
            for x, above in zip(self.x, self.above, strict=True):  # both axes at once would take twice as long
                x[front.rows] += above[:below]

    def backward(self, front: Front) -> None:
        """What L^-T does by this front."""
        size, below = front.size, len(front.rows)
        for x, above in zip(self.x, self.above, strict=True):
            above[:below] = x[front.rows]
        for begin, end, corner in reversed(self._stretches(front)):
            n, rest, ahead = end - begin, front.width - end, self.item * (end - begin)
            for own, held in self.places:
                here = own + self.item * (front.first + begin)
                if below:
                    rows = corner + self.item * (front.width - begin)
                    self.vectors.subtract(True, (below, n), rows, size, held, here, keep=True)
                if rest:
                    self.vectors.subtract(True, (rest, n), corner + ahead, size, here + ahead, here, keep=True)
                self.vectors.solve(True, n, corner, size, here)

    def _stretches(self, front: Front) -> list[tuple[int, int, int]]:
        """First and last columns that are met together, and where their part of the diagonal begins."""
        at_once = front.width if len(self.x) == 1 else max(CACHE // (self.item * front.size), 1)
        first = self.factor + self.item * front.panel
        return [
            (begin, min(begin + at_once, front.width), first + self.item * begin * (front.size + 1))
            for begin in range(0, front.width, at_once)
        ]


def _side_by_side(plan: Plan, factor: Matrix, x: Matrix) -> None:
    """L^-T L^-1 X in place of X (n, m), rows in the order of elimination."""
    subtrees = [plan.fronts[subtree.start : subtree.stop] for step in plan.steps for subtree in step.subtrees]
    above = [plan.fronts[s] for step in plan.steps for s in step.then]
    ends = np.linspace(0, x.shape[1], min(plan.threads, x.shape[1]) + 1).astype(int).tolist()

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

    with pool_of(plan.threads) as pool:
        for rows, change in pool.map(up, subtrees):
            x[rows] += change
        list(pool.map(over, pairwise(ends)))
        list(pool.map(lambda subtree: _backward(subtree, factor, x), subtrees))


def _forward(fronts: Iterable[Front], factor: Matrix, x: Matrix) -> None:
    """What L^-1 does to X (n, m) by these fronts, children before their parents."""
    for front in fronts:
        panel, own = panel_of(factor, front), x[front.first : front.first + front.width]
        triangle, rest = panel[: front.width], panel[front.width :]
        dense.solve_transposed(triangle, own.T)
        change = np.empty((len(rest), x.shape[1]), x.dtype)
        if len(rest):
            dense.subtract_product(change.T, own.T, rest, keep=0.0)
        x[front.rows] += change


def _backward(fronts: Iterable[Front], factor: Matrix, x: Matrix) -> None:
    """What L^-T does to X (n, m) by these fronts, parents before their children."""
    for front in reversed(tuple(fronts)):
        panel, own = panel_of(factor, front), x[front.first : front.first + front.width]
        triangle, rest = panel[: front.width], panel[front.width :]
        if len(rest):
            dense.subtract_product(own.T, x[front.rows].T, rest, transposed=False)
        dense.solve_right(triangle, own.T)
