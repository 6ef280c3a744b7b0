"""The factor's numbers: fronts eliminated one after the other, subtrees of them side by side."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from palpate.errors import SolverError
from palpate.mechanics.solvers.multifrontal import dense
from palpate.mechanics.solvers.multifrontal.dense import Matrix
from palpate.mechanics.solvers.multifrontal.plan import Front, Plan, panel_of

__all__ = ["factorised"]

BLOCK = 256  # columns of a large front that are eliminated before the others hear of them
Everywhere = Callable[[Callable[[Any], None], Iterable[Any]], None]


@dataclass(frozen=True, slots=True)
class _Work:
    """A factorisation under way: the matrix' entries (nnz,), the factor and the working memory."""

    plan: Plan
    data: NDArray[np.float64]
    factor: Matrix
    memory: Matrix

    def contribution(self, front: Front) -> Matrix:
        """What a front adds to its parent (below, below), lower triangle."""
        m = len(front.rows)
        return self.memory[front.contribution : front.contribution + m * m].reshape(m, m).T


def factorised(plan: Plan, data: NDArray[np.float64], dtype: type, threads: int) -> Matrix:
    """The factor's columns, one front's after the other, of the matrix with the plan's pattern and entries (nnz,)."""
    work = _Work(plan, data, np.zeros(plan.factor_size, dtype), np.zeros(plan.work_size, dtype))
    if threads == 1:
        for step in plan.steps:
            for subtree in step.subtrees:
                _eliminate_subtree(work, subtree)
            for s in step.then:
                _eliminate(work, plan.fronts[s])
        return work.factor
    with ThreadPoolExecutor(threads) as pool:

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
    children = [work.plan.fronts[child] for child in front.children]
    for child in children:
        _add(panel, work.contribution(child), child.runs, 0, w, 0)
    _check(work, front, dense.factor(panel[:w]))
    if not len(front.rows):
        return
    dense.solve_transposed(panel[:w], panel[w:])
    rest = work.contribution(front)
    dense.subtract_square(rest, panel[w:], keep=0.0)
    for child in children:
        _add(rest, work.contribution(child), child.runs, w, front.size, w)


def _eliminate_large(work: _Work, front: Front, threads: int, everywhere: Everywhere) -> None:
    """One front by all threads: blocks of columns in turn, each part of what is right of them by another thread."""
    panel, w, size = _assembled(work, front), front.width, front.size
    children = [work.plan.fronts[child] for child in front.children]

    def add(matrix: Matrix, part: tuple[int, int], shift: int) -> None:
        for child in children:
            _add(matrix, work.contribution(child), child.runs, *part, shift)

    everywhere(lambda part: add(panel, part, 0), _parts(0, w, size, threads))
    for begin in range(0, w, BLOCK):
        end = min(begin + BLOCK, w)
        pivot = panel[begin:end, begin:end]
        _check(work, front, dense.factor(pivot), begin)
        rows = np.linspace(end, size, threads + 1).astype(int).tolist()
        slices = [slice(a, b) for a, b in zip(rows[:-1], rows[1:], strict=True) if b > a]
        everywhere(lambda rows: dense.solve_transposed(pivot, panel[rows, begin:end]), slices)
        done = panel[:, begin:end]
        everywhere(lambda part: _update(panel, done, *part, 0, 1.0), _parts(end, w, size, threads))
    if size > w:
        rest = work.contribution(front)

        def remainder(part: tuple[int, int]) -> None:
            _update(rest, panel, *part, w, 0.0)
            add(rest, part, w)

        everywhere(remainder, _parts(w, size, size, threads))


def _update(matrix: Matrix, done: Matrix, low: int, high: int, shift: int, keep: float) -> None:
    """Columns low to high of a front less the product of the columns that are `done`, below the diagonal."""
    columns = slice(low - shift, high - shift)
    dense.subtract_square(matrix[columns, columns], done[low:high], keep=keep)
    if high < len(done):
        dense.subtract_product(matrix[high - shift :, columns], done[high:], done[low:high], keep=keep)


def _parts(low: int, high: int, size: int, threads: int) -> list[tuple[int, int]]:
    """Columns low to high in as many ranges as there are threads, of equal area below the diagonal of `size` rows."""
    if high - low < 2 * threads:
        return [(low, high)] if high > low else []
    area = np.cumsum(size - np.arange(low, high))
    bounds = np.searchsorted(area, area[-1] * np.arange(1, threads) / threads)
    ends = [low, *(low + bounds).tolist(), high]
    return [(a, b) for a, b in zip(ends[:-1], ends[1:], strict=True) if b > a]


def _assembled(work: _Work, front: Front) -> Matrix:
    """The front's columns with the matrix' entries alone."""
    panel = panel_of(work.factor, front)
    plan, entries = work.plan, front.entries
    flat = work.factor[front.panel : front.panel + front.size * front.width]
    flat[plan.target[entries]] = work.data[plan.source[entries]]
    return panel


def _add(matrix: Matrix, contribution: Matrix, runs: tuple[tuple[int, int, int], ...], low: int, high: int, shift: int) -> None:
    """Add to columns low to high of a front what a child contributes to them; matrix: the front from `shift` on."""
    for number, (start, there, length) in enumerate(runs):
        begin, end = max(there, low), min(there + length, high)
        if begin >= end:
            continue
        columns = slice(start + begin - there, start + end - there)
        target = matrix[:, begin - shift : end - shift]
        for row, row_there, count in runs[number:]:
            part = target[row_there - shift : row_there - shift + count]
            np.add(part, contribution[row : row + count, columns], out=part)


def _check(work: _Work, front: Front, pivot: int, before: int = 0) -> None:
    if pivot:
        n = len(work.plan.order)
        raise SolverError(
            f"the stiffness of {n} unknowns is not positive definite: pivot {front.first + before + pivot} of"
            " elimination is not positive; hold the body somewhere and check for inverted tetrahedra"
        )
