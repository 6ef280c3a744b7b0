"""Multifrontal Cholesky factorisation: the direct solver that needs NumPy and SciPy alone.

Duff & Reid, ACM TOMS 9 (1983) 302-325; Liu, SIAM Review 34 (1992) 82-109. Fronts are dense, of supernodes merged as by
Ashcraft & Grimes, ACM TOMS 15 (1989) 291-309, and all arithmetic on them is LAPACK's. What follows from the pattern
alone is kept for the next matrix with the same one.
"""

from __future__ import annotations

import functools
import hashlib
import threading
from collections import OrderedDict
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from palpate.errors import ResourceError, SolverError
from palpate.mechanics.solvers.conjugate_gradients import conjugate_gradients
from palpate.mechanics.solvers.contract import EXACT, Expectation, Factorisation, Factoriser, Hints, Solver
from palpate.mechanics.solvers.multifrontal.dense import Matrix
from palpate.mechanics.solvers.multifrontal.expectation import PRODUCT, expected, expected_of_size
from palpate.mechanics.solvers.multifrontal.numeric import factorised
from palpate.mechanics.solvers.multifrontal.plan import Plan, make_plan
from palpate.mechanics.solvers.multifrontal.substitution import substituted
from palpate.memory import available_memory
from palpate.parallel import blas_on_one_thread, processors

__all__ = ["MIXED", "SOLVER", "plan_of"]

KEPT_PLANS = 2  # of a linear and a finite-strain model of one mesh
HOPELESS = 4.0  # times the free memory; a pattern of such a size is not analysed to know more exactly
MAX_REFINEMENTS = 8  # steps of conjugate gradients; where they do not suffice, double precision costs less


@dataclass(frozen=True, slots=True)
class MultifrontalFactorisation:
    """Factors in double precision."""

    plan: Plan
    factor: Matrix

    def solve(self, rhs: NDArray[np.float64], *, tolerance: float = EXACT) -> NDArray[np.float64]:
        """Solution X (n, m) of A X = rhs (n, m) to rounding, whatever the `tolerance`."""
        del tolerance
        return self.nearly(rhs)

    def nearly(self, rhs: NDArray[np.float64]) -> NDArray[np.float64]:
        """A^-1 rhs (n, m) to rounding."""
        with blas_on_one_thread():
            return substituted(self.plan, self.factor, rhs, processors())


@dataclass(frozen=True, slots=True)
class MixedFactorisation:
    """Factors in single precision of the matrix over `scale`, and conjugate gradients with the matrix in double."""

    matrix: sparse.csr_matrix[np.float64]
    plan: Plan
    factor: Matrix
    scale: float

    def nearly(self, rhs: NDArray[np.float64]) -> NDArray[np.float64]:
        """A^-1 rhs (n, m) to single precision."""
        sizes = np.maximum(np.abs(rhs).max(axis=0, initial=0.0), np.finfo(np.float64).tiny)  # single has a small range
        with blas_on_one_thread():
            rough = substituted(self.plan, self.factor, rhs / sizes, processors())
        return np.asarray(rough * (sizes / self.scale))

    def solve(self, rhs: NDArray[np.float64], *, tolerance: float = EXACT) -> NDArray[np.float64]:
        """Solution X (n, m) of A X = rhs (n, m) to a relative residual of `tolerance`; raises `SolverError`."""
        steps = MAX_REFINEMENTS
        return conjugate_gradients(self.matrix, rhs, self.nearly, tolerance=tolerance, max_iterations=steps)[0]


class _Plans:
    """Plans of the patterns that were factorised last."""

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


def plan_of(matrix: sparse.csr_matrix[np.float64]) -> Plan:
    """What a factorisation of the symmetric matrix (n, n) will do, for as many threads as there are processors."""
    return _plans.of(_canonical(matrix), processors())


def _canonical(matrix: sparse.csr_matrix[np.float64]) -> sparse.csr_matrix[np.float64]:
    if matrix.has_canonical_format:
        return matrix
    copied = matrix.copy()
    copied.sum_duplicates()
    return copied


def _factor(matrix: sparse.csr_matrix[np.float64], plan: Plan, dtype: type, scale: float = 1.0) -> Matrix:
    """The factor of a canonical matrix over `scale`; raises `SolverError`, `ResourceError`."""
    needed = float(plan.factor_size + plan.work_size) * np.dtype(dtype).itemsize
    free = available_memory()
    if free is not None and needed > free:
        raise ResourceError(
            f"the factor of {matrix.shape[0]} unknowns needs {needed / 1e9:.2g} GB and {free / 1e9:.2g} GB are free:"
            " use a coarser mesh or solver 'multigrid', or end other programs"
        )
    with blas_on_one_thread():
        return factorised(plan, matrix.data / scale, dtype, processors())


def _factorise(matrix: sparse.csr_matrix[np.float64], hints: Hints) -> Factorisation:
    del hints  # elimination has no use for it
    canonical = _canonical(matrix)
    plan = plan_of(canonical)
    return MultifrontalFactorisation(plan, _factor(canonical, plan, np.float64))


def _factorise_mixed(matrix: sparse.csr_matrix[np.float64], hints: Hints) -> Factorisation:
    """In single precision; in double where rounding makes that indefinite, or its refinement slow."""
    canonical = _canonical(matrix)
    plan = plan_of(canonical)
    scale = float(np.abs(matrix.data).max(initial=0.0)) or 1.0
    try:
        mixed = MixedFactorisation(canonical, plan, _factor(canonical, plan, np.float32, scale), scale)
        mixed.solve(np.random.default_rng(0).standard_normal((matrix.shape[0], 1)))
    except SolverError:
        return _factorise(matrix, hints)
    return mixed


def _expect(matrix: sparse.csr_matrix[np.float64], hints: Hints, dtype: type) -> Expectation:
    """From the plan, which the factorisation then finds ready."""
    free, rough = available_memory(), expected_of_size(matrix.shape[0], hints.right_hand_sides, dtype)
    if free is not None and rough.bytes > HOPELESS * free:
        return rough
    plan = plan_of(matrix)
    sizes = (plan.operations, plan.factor_size, plan.work_size)
    return expected(*sizes, hints.right_hand_sides, dtype, PRODUCT * matrix.nnz)


def _solver(name: str, factorise: Factoriser, dtype: type) -> Solver:
    expect, of_size = functools.partial(_expect, dtype=dtype), functools.partial(expected_of_size, dtype=dtype)
    return Solver(name, factorise, True, expect, of_size)


SOLVER = _solver("multifrontal", _factorise, np.float64)
MIXED = _solver("multifrontal-single", _factorise_mixed, np.float32)
