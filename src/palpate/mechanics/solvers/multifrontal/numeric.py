"""The factor's numbers: fronts eliminated one after the other, subtrees of them side by side."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from palpate.errors import SolverError
from palpate.mechanics.solvers.multifrontal import dense
from palpate.mechanics.solvers.multifrontal.dense import Matrix
from palpate.mechanics.solvers.multifrontal.plan import Front, Plan, blocks_of, panel_of
from palpate.parallel import pool_of

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
        n = len(work.plan.order)
        raise SolverError(
            f"the stiffness of {n} unknowns is not positive definite: pivot {front.first + before + pivot} of"
            " elimination is not positive; hold the body somewhere and check for inverted tetrahedra"
        )
