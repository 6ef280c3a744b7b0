"""Solutions with a matrix whose factorisation belongs to a similar one: an older tangent, or its symmetric part."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.sparse.linalg import LinearOperator, gmres

from palpate.errors import SolverError
from palpate.mechanics.solvers.conjugate_gradients import conjugate_gradients, times
from palpate.mechanics.solvers.contract import Factorisation

TIGHT = 1e-12  # relative residual that is sought
ACCEPTED = 1e-9  # relative residual that is accepted where rounding stops the iteration
MAX_ITERATIONS = 100
RESTARTS = 3  # from the true residual, which is larger than GMRES' own with a factor in single precision


@dataclass(frozen=True, slots=True)
class LinearisedSystem:
    """A matrix A (n, n), mN/mm, with the factorisation of one near it; `symmetric`: whether A is."""

    matrix: sparse.csr_matrix[np.float64]
    nearby: Factorisation
    symmetric: bool

    def transposed(self) -> LinearisedSystem:
        """The system of A^T; the factorisation, of a symmetric matrix, serves both."""
        return self if self.symmetric else replace(self, matrix=sparse.csr_matrix(self.matrix.T))

    def solve(self, rhs: NDArray[np.float64], *, tolerance: float = TIGHT) -> NDArray[np.float64]:
        """Solution X (n, m) of A X = rhs (n, m) to a relative residual of `tolerance`; raises `SolverError`."""
        if not self.symmetric:
            return np.stack([self._unsymmetric(column, tolerance) for column in rhs.T], axis=1)
        product, nearly = partial(times, self.matrix), self.nearby.nearly
        solution, _ = conjugate_gradients(product, rhs, nearly, tolerance=tolerance, max_iterations=MAX_ITERATIONS)
        return solution

    def nearly(self, rhs: NDArray[np.float64]) -> NDArray[np.float64]:
        """Nearly A^-1 rhs (n, m): with the factorisation alone."""
        return self.nearby.nearly(rhs)

    def _unsymmetric(self, rhs: NDArray[np.float64], tolerance: float) -> NDArray[np.float64]:
        """GMRES: Saad & Schultz, SIAM J. Sci. Stat. Comput. 7 (1986) 856-869."""
        n = len(rhs)
        inverse = LinearOperator((n, n), matvec=lambda r: self.nearby.nearly(r.reshape(-1, 1))[:, 0], dtype=np.float64)
        solution, _ = gmres(self.matrix, rhs, rtol=tolerance, restart=MAX_ITERATIONS, maxiter=RESTARTS, M=inverse)
        share = float(np.linalg.norm(rhs - self.matrix @ solution) / (np.linalg.norm(rhs) or 1.0))
        if not share <= max(ACCEPTED, tolerance):
            raise SolverError(
                f"GMRES stopped at a relative residual of {share:.2g} in {n} unknowns: the loads that follow the body"
                " are too large for its stiffness"
            )
        return np.asarray(solution)


def symmetric_part(matrix: sparse.csr_matrix[np.float64]) -> sparse.csr_matrix[np.float64]:
    """(A + A^T) / 2 (n, n), in the unit of A."""
    result = sparse.csr_matrix(0.5 * (matrix + matrix.T))
    result.sort_indices()
    return result
