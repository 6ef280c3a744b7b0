"""SuperLU in its symmetric mode on a nested dissection by METIS: the direct solver that every wheel carries.

Li, ACM TOMS 31 (2005) 302-325.
"""

from __future__ import annotations

import warnings
from concurrent.futures import ThreadPoolExecutor

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.sparse.linalg import MatrixRankWarning, splu

from palpate.errors import SolverError
from palpate.mechanics.solvers.contract import Factorisation, Hints, Solver, always
from palpate.mechanics.solvers.pattern import nested_dissection
from palpate.parallel import processors

__all__ = ["SOLVER"]

BLOCK = 16  # columns a thread solves at once: more of them fall out of the cache
MAX_THREADS = 8


class SuperluFactorisation:
    """Factors of the matrix whose rows and columns are taken in the order `permutation` (n,)."""

    __slots__ = ("_factors", "_permutation")

    def __init__(self, matrix: sparse.csr_matrix[np.float64], permutation: NDArray[np.int64]) -> None:
        self._permutation = permutation
        ordered = matrix[permutation][:, permutation].tocsc()
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", MatrixRankWarning)  # raised below, with the figures
                # No pivoting: a symmetric positive definite matrix needs none, and it would spoil the ordering.
                self._factors = splu(
                    ordered, permc_spec="NATURAL", diag_pivot_thresh=0.0, options={"SymmetricMode": True}
                )
        except (RuntimeError, MemoryError) as error:
            raise SolverError(
                f"SuperLU could not factorise {matrix.shape[0]} unknowns ({error}): hold the body somewhere, check for"
                " inverted tetrahedra, or if memory ran out use a coarser mesh or solver 'multigrid'"
            ) from error
        self._refuse_indefinite()

    def _refuse_indefinite(self) -> None:
        pivots = self._factors.U.diagonal()
        if not pivots.min() > 0.0:
            raise SolverError(
                f"the stiffness of {len(pivots)} unknowns is not positive definite: {int((pivots <= 0.0).sum())} pivots"
                f" are not positive, the smallest is {pivots.min():.3g} of {pivots.max():.3g}; hold the body somewhere"
                " and check for inverted tetrahedra"
            )

    def solve(self, rhs: NDArray[np.float64]) -> NDArray[np.float64]:
        """Solution X (n, m) of A X = rhs (n, m), blocks of columns side by side: the factors are only read."""
        solution = np.empty_like(rhs)

        def solve_block(start: int) -> None:
            """The columns from `start` on."""
            block = slice(start, start + BLOCK)
            ordered = np.asfortranarray(rhs[self._permutation, block])
            solution[self._permutation, block] = self._factors.solve(ordered)

        with ThreadPoolExecutor(min(MAX_THREADS, processors())) as threads:
            list(threads.map(solve_block, range(0, rhs.shape[1], BLOCK)))
        return solution


def _factorise(matrix: sparse.csr_matrix[np.float64], hints: Hints) -> Factorisation:
    del hints  # elimination has no use for it
    return SuperluFactorisation(matrix, nested_dissection(matrix))


SOLVER = Solver("superlu", _factorise, True, always)
