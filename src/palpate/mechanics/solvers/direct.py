"""Multifrontal Cholesky factorisation, in double precision or in single, which conjugate gradients refine."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

import multifrontal
from multifrontal import NotPositiveDefinite
from palpate.errors import ResourceError, SolverError
from palpate.mechanics.solvers.conjugate_gradients import conjugate_gradients, times
from palpate.mechanics.solvers.contract import EXACT, Expectation, Factorisation, Factoriser, Hints, Solver
from palpate.parallel import processors
from palpate.processes import available_memory

HOPELESS = 4.0  # times the free memory: a matrix of such an expected size is not even analysed
MAX_REFINEMENTS = 8  # steps of conjugate gradients; where they do not suffice, double precision costs less
# Measured on one thread of a 2.4 GHz AMD EPYC, 29 631 and 111 273 unknowns, blocks of right-hand sides: operations a
# second; seconds for each number of the factor and right-hand side, and for each entry of a product with the matrix.
SPEED = {np.dtype(np.float64): 3.5e10, np.dtype(np.float32): 6.8e10}
PER_NUMBER = {np.dtype(np.float64): 1.2e-10, np.dtype(np.float32): 7.3e-11}
PRODUCT = 6e-10
PARALLEL = 0.85  # share of a processor's speed that each further one adds
# Stiffnesses of quadratic tetrahedra of the same two sizes n: operations / n^2, numbers / n^(4/3), entries / n.
OPERATIONS, FACTOR, WORK, ENTRIES = 21.0, 25.2, 6.0, 81.0


@dataclass(frozen=True, slots=True)
class DirectFactorisation:
    """A factor in double precision."""

    factor: multifrontal.Factor

    def solve(self, rhs: NDArray[np.float64], *, tolerance: float = EXACT) -> NDArray[np.float64]:
        """Solution X (n, m) of A X = rhs (n, m) to rounding, whatever the `tolerance`."""
        del tolerance
        return self.factor.solve(rhs)

    def nearly(self, rhs: NDArray[np.float64]) -> NDArray[np.float64]:
        """A^-1 rhs (n, m) to rounding."""
        return self.factor.solve(rhs)


@dataclass(frozen=True, slots=True)
class MixedFactorisation:
    """A factor in single precision, and conjugate gradients with the matrix in double."""

    matrix: sparse.csr_matrix[np.float64]
    factor: multifrontal.Factor

    def nearly(self, rhs: NDArray[np.float64]) -> NDArray[np.float64]:
        """A^-1 rhs (n, m) to single precision."""
        return self.factor.solve(rhs)

    def solve(self, rhs: NDArray[np.float64], *, tolerance: float = EXACT) -> NDArray[np.float64]:
        """Solution X (n, m) of A X = rhs (n, m) to a relative residual of `tolerance`; raises `SolverError`."""
        steps = MAX_REFINEMENTS
        return conjugate_gradients(
            partial(times, self.matrix), rhs, self.nearly, tolerance=tolerance, max_iterations=steps
        )[0]


def _factor(matrix: sparse.csr_matrix[np.float64], dtype: type) -> multifrontal.Factor:
    """The factor of a matrix; raises `SolverError`, and `ResourceError` before it takes memory that is not there."""
    plan = multifrontal.analyse(matrix)
    needed, free = plan.bytes(dtype), available_memory()
    if free is not None and needed > free:
        raise ResourceError(
            f"the factor of {matrix.shape[0]} unknowns needs {needed / 1e9:.2g} GB and {free / 1e9:.2g} GB are free:"
            " use a coarser mesh or solver 'multigrid', or end other programs"
        )
    try:
        return multifrontal.factorise(matrix, dtype=dtype, plan=plan)
    except NotPositiveDefinite as error:
        raise SolverError(
            f"the stiffness of {error.n} unknowns is not positive definite: pivot {error.pivot} of elimination is not"
            " positive; hold the body somewhere and check for inverted tetrahedra"
        ) from error


def _factorise(matrix: sparse.csr_matrix[np.float64], hints: Hints) -> Factorisation:
    del hints  # elimination has no use for it
    return DirectFactorisation(_factor(matrix, np.float64))


def _factorise_mixed(matrix: sparse.csr_matrix[np.float64], hints: Hints) -> Factorisation:
    """In single precision; in double where rounding makes that indefinite, or its refinement slow."""
    try:
        mixed = MixedFactorisation(matrix, _factor(matrix, np.float32))
        mixed.solve(np.random.default_rng(0).standard_normal((matrix.shape[0], 1)))
    except SolverError:
        return _factorise(matrix, hints)
    return mixed


def _expected(operations: float, numbers: float, work: float, rhs: int, dtype: type, entries: float) -> Expectation:
    """Seconds and bytes of a factorisation and so many right-hand sides, each in single precision refined once."""
    kind = np.dtype(dtype)
    refining = 0.0 if dtype is np.float64 else PRODUCT * entries
    seconds = operations / SPEED[kind] + rhs * (PER_NUMBER[kind] * numbers + refining)
    return Expectation(seconds / (1.0 + PARALLEL * (processors() - 1)), (numbers + work) * kind.itemsize)


def _expect_of_size(unknowns: int, right_hand_sides: int, dtype: type) -> Expectation:
    """Of a mesh of quadratic tetrahedra that is known by the number of its unknowns alone."""
    numbers = float(unknowns) ** (4.0 / 3.0)
    sizes = (OPERATIONS * float(unknowns) ** 2, FACTOR * numbers, WORK * numbers)
    return _expected(*sizes, right_hand_sides, dtype, ENTRIES * unknowns)


def _expect(matrix: sparse.csr_matrix[np.float64], hints: Hints, dtype: type) -> Expectation:
    """From the plan, which the factorisation then finds ready."""
    free, rough = available_memory(), _expect_of_size(matrix.shape[0], hints.right_hand_sides, dtype)
    if free is not None and rough.bytes > HOPELESS * free:
        return rough
    plan = multifrontal.analyse(matrix)
    return _expected(plan.operations, plan.factor_size, plan.work_size, hints.right_hand_sides, dtype, matrix.nnz)


def _solver(name: str, factorise: Factoriser, dtype: type) -> Solver:
    expect, of_size = partial(_expect, dtype=dtype), partial(_expect_of_size, dtype=dtype)
    return Solver(name, factorise, True, expect, of_size)


SOLVER = _solver("multifrontal", _factorise, np.float64)
MIXED = _solver("multifrontal-single", _factorise_mixed, np.float32)
