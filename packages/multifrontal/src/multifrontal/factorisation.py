"""A matrix made ready to be solved with: what its pattern tells, once for all matrices that have it, and its factor."""

from __future__ import annotations

import hashlib
import threading
from collections import OrderedDict
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from multifrontal.dense import Matrix, blas_on_one_thread, processors
from multifrontal.numeric import factorised, substituted
from multifrontal.plan import Plan, make_plan

__all__ = ["Factor", "analyse", "factorise"]

KEPT_PLANS = 2  # of the patterns that came last
SYMMETRIC = 1e-3  # by which a row and its column may differ, relative to the row: rounding cancels entries on one side


@dataclass(frozen=True, slots=True)
class Factor:
    """L of A / scale = L L^T, its numbers (factor_size,) in single or double precision laid out as the plan says."""

    plan: Plan
    numbers: Matrix
    scale: float = 1.0

    def solve(self, rhs: NDArray[np.float64]) -> NDArray[np.float64]:
        """A^-1 rhs for one right-hand side (n,) or several (n, m), to the rounding of the factor's precision."""
        with blas_on_one_thread():
            found = substituted(self.plan, self.numbers, rhs[:, None] if rhs.ndim == 1 else rhs, scale=self.scale)
        return found.reshape(rhs.shape)


class _Plans:
    """Plans of the patterns that were analysed last."""

    def __init__(self) -> None:
        self.lock = threading.Lock()
        self.kept: OrderedDict[tuple[bytes, int], Plan] = OrderedDict()

    def of(self, matrix: sparse.csr_matrix[np.float64], threads: int) -> Plan:
        """The plan for a canonical matrix, kept or new."""
        digest = hashlib.blake2b(matrix.indptr.tobytes())
        digest.update(matrix.indices.tobytes())
        key = digest.digest(), threads
        with self.lock:
            plan = self.kept.pop(key, None) or make_plan(matrix, threads)
            self.kept[key] = plan
            while len(self.kept) > KEPT_PLANS:
                self.kept.popitem(last=False)
        return plan


_plans = _Plans()


def analyse(matrix: sparse.csr_matrix[np.float64], *, threads: int | None = None) -> Plan:
    """What a factorisation of the symmetric matrix (n, n), n > 0, will do and take; only where its entries lie counts.

    threads: as many as there are `processors` if nothing is said. The plans of the last two patterns are kept.
    """
    return _plans.of(_canonical(matrix), processors() if threads is None else threads)


def factorise(matrix: sparse.csr_matrix[np.float64], *, dtype: type = np.float64, plan: Plan | None = None) -> Factor:
    """The factor of the symmetric positive definite `matrix` (n, n), both of its triangles stored.

    dtype: np.float64, or np.float32 for half of the memory and nearly twice the speed; the largest entry is scaled to 1
    then, for single precision has a small range. plan: that of its pattern, by `analyse`. Raises `NotPositiveDefinite`,
    and `ValueError` for a matrix that is not symmetric, as is one of which one triangle alone is stored.
    """
    canonical, scale = _canonical(matrix), 1.0
    _refuse_unsymmetric(canonical)
    known, entries = analyse(canonical) if plan is None else plan, canonical.data
    if np.dtype(dtype) == np.float32:
        scale = float(np.abs(entries).max(initial=0.0)) or 1.0
        entries = entries / scale
    with blas_on_one_thread():
        return Factor(known, factorised(known, entries, dtype), scale)


def _canonical(matrix: sparse.csr_matrix[np.float64]) -> sparse.csr_matrix[np.float64]:
    """The matrix by rows, sorted, each entry once."""
    by_rows = sparse.csr_matrix(matrix)
    if by_rows.has_canonical_format:
        return by_rows
    copied = by_rows.copy()
    copied.sum_duplicates()
    return copied


def _refuse_unsymmetric(matrix: sparse.csr_matrix[np.float64]) -> None:
    """Raise `ValueError` where one triangle alone has entries, and where A x and A^T x differ for an x drawn by lot."""
    n = matrix.shape[0]
    places = matrix.indices - np.repeat(np.arange(n), np.diff(matrix.indptr))
    if np.any(places < 0) != np.any(places > 0):
        raise ValueError(
            f"one triangle alone of the matrix of {n} unknowns is stored; store both: of a triangle T,"
            " T + T.T - scipy.sparse.diags_array(T.diagonal())"
        )
    drawn = np.random.default_rng(0).uniform(-1.0, 1.0, n)
    with np.errstate(invalid="ignore"):  # what is not finite has no positive pivot
        off = np.abs(np.asarray(matrix @ drawn) - np.asarray(matrix.T @ drawn))
        beyond = off - SYMMETRIC * np.asarray(abs(matrix) @ np.abs(drawn))
    if beyond.max() > 0.0:
        raise ValueError(
            f"the matrix of {n} unknowns is not symmetric: row and column {int(np.argmax(beyond))} differ; this solver"
            " takes the same entries in both triangles"
        )
