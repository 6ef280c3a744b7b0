"""What a factorisation takes, from the sizes in its plan or from the number of unknowns alone."""

from __future__ import annotations

import numpy as np

from palpate.mechanics.solvers.contract import Expectation
from palpate.parallel import processors

__all__ = ["PRODUCT", "expected", "expected_of_size"]

# Measured on one thread of a 2.4 GHz AMD EPYC, 29 631 and 111 273 unknowns, blocks of right-hand sides: operations a
# second; seconds for each number of the factor and right-hand side, and for each entry of a product with the matrix.
SPEED = {np.dtype(np.float64): 3.5e10, np.dtype(np.float32): 6.8e10}
PER_NUMBER = {np.dtype(np.float64): 1.2e-10, np.dtype(np.float32): 7.3e-11}
PRODUCT = 6e-10
PASSES = 1.0  # that single precision takes to a relative residual of 1e-5, as nearly all solutions are asked for
PARALLEL = 0.85  # of a processor's speed that every further one adds
# Stiffnesses of quadratic tetrahedra of the same two sizes n: operations / n^2, numbers / n^(4/3), entries / n.
OPERATIONS, FACTOR, WORK, ENTRIES = 21.0, 25.2, 6.0, 81.0


def expected(
    operations: float, factor_size: float, work_size: float, rhs: int, dtype: type, products: float
) -> Expectation:
    """Seconds and bytes of a factorisation and so many right-hand sides; products: seconds of a product with one."""
    work, per_number = SPEED[np.dtype(dtype)], PER_NUMBER[np.dtype(dtype)]
    threads = 1.0 + PARALLEL * (processors() - 1)
    passes = 1.0 if dtype is np.float64 else PASSES
    solving = rhs * passes * (per_number * factor_size + (0.0 if dtype is np.float64 else products))
    return Expectation((operations / work + solving) / threads, (factor_size + work_size) * np.dtype(dtype).itemsize)


def expected_of_size(unknowns: int, right_hand_sides: int, dtype: type) -> Expectation:
    """Of a mesh of quadratic tetrahedra that is known by the number of its unknowns alone."""
    numbers = float(unknowns) ** (4.0 / 3.0)
    sizes = (OPERATIONS * float(unknowns) ** 2, FACTOR * numbers, WORK * numbers)
    return expected(*sizes, right_hand_sides, dtype, PRODUCT * ENTRIES * unknowns)
