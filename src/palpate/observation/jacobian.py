"""The Jacobian of residuals by unknowns as a product of a sparse and a small dense matrix, which is never formed.

A surface has many times more residuals than displacements, and far more than unknowns: formed, the Jacobians would be
the largest things there are, and their products the longest part of an evaluation.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

ROWS = 8192  # residuals whose rows are formed at once: some 30 MB
FACTORED_ABOVE = (
    4  # residuals for each displacement, above which products with the sparse factor cost less than J itself
)


@dataclass(frozen=True, slots=True)
class Jacobian:
    """J = S T (n, n_columns) of one observation, mm per unit of each unknown.

    by_displacement: S (n, n_dofs + 1 + n_direct), dimensionless, its column n_dofs 1: the derivative by an offset of
    all residuals; then those by ln E and the material at held displacements, where there are any; tangent: T, one row a
    column of S, the derivatives of displacements (mm), offset, ln E and material by the unknowns.
    """

    by_displacement: sparse.csr_matrix[np.float64]
    tangent: NDArray[np.float64]

    @property
    def shape(self) -> tuple[int, int]:
        """(n, n_columns)."""
        return int(self.by_displacement.shape[0]), int(self.tangent.shape[1])

    def times(self, values: NDArray[np.float64]) -> NDArray[np.float64]:
        """J x (n,) or (n, k) for x (n_columns,) or (n_columns, k)."""
        return np.asarray(self.by_displacement @ (self.tangent @ values))

    def transposed_times(self, values: NDArray[np.float64]) -> NDArray[np.float64]:
        """J^T y (n_columns,) or (n_columns, k) for y (n,) or (n, k)."""
        return np.asarray(self.tangent.T @ (self.by_displacement.T @ values))

    def gram(self, weights: NDArray[np.float64]) -> NDArray[np.float64]:
        """J^T W J (n_columns, n_columns) for W = diag(weights (n,)), none negative."""
        matrix, total = self.by_displacement, np.zeros(2 * (self.tangent.shape[1],))
        if matrix.shape[0] < FACTORED_ABOVE * matrix.shape[1]:
            for start in range(0, matrix.shape[0], ROWS):
                part = slice(start, start + ROWS)
                formed = np.asarray(matrix[part] @ self.tangent)
                formed *= np.sqrt(weights[part])[:, None]
                total += formed.T @ formed
            return total
        scaled = np.repeat(np.sqrt(weights), np.diff(matrix.indptr)) * matrix.data
        root = sparse.csr_matrix((scaled, matrix.indices, matrix.indptr), shape=matrix.shape)
        return np.asarray(self.tangent.T @ (sparse.csr_matrix(root.T @ root) @ self.tangent))

    def changed_gram(self, gram: NDArray[np.float64], change: NDArray[np.float64]) -> NDArray[np.float64]:
        """J^T (W + diag(change)) J (n_columns, n_columns) from the gram J^T W J; change (n,) of weights, few not 0."""
        rows = np.flatnonzero(change)
        formed = np.asarray(self.by_displacement[rows] @ self.tangent)
        return np.asarray(gram + formed.T @ (change[rows, None] * formed))

    def summed(self, rows: sparse.csr_matrix[np.float64]) -> NDArray[np.float64]:
        """A J (m, n_columns) for sparse sums A (m, n) of residuals."""
        return np.asarray(sparse.csr_matrix(rows @ self.by_displacement) @ self.tangent)

    @classmethod
    def of(cls, matrix: NDArray[np.float64]) -> Jacobian:
        """That of residuals that are themselves what the unknowns move, J (n, n_columns)."""
        return cls(sparse.csr_matrix(matrix), np.eye(matrix.shape[1]))

    def of_columns(self, columns: NDArray[np.bool_] | NDArray[np.int64]) -> Jacobian:
        """The same by some of the unknowns, a mask or numbers of them."""
        return replace(self, tangent=self.tangent[:, columns])

    def of_rows(self, rows: slice) -> Jacobian:
        """The same of some of the residuals."""
        return replace(self, by_displacement=sparse.csr_matrix(self.by_displacement[rows]))

    def with_tangent(self, tangent: NDArray[np.float64]) -> Jacobian:
        """The same with other derivatives of the displacements (n_dofs, k) by the first k unknowns."""
        whole = self.tangent.copy()
        whole[: len(tangent), : tangent.shape[1]] = tangent
        return replace(self, tangent=whole)

    @property
    def dense(self) -> NDArray[np.float64]:
        """J (n, n_columns) itself."""
        return self.times(np.eye(self.tangent.shape[1]))


def jacobian_of(
    smooth: sparse.csr_matrix[np.float64],
    tangent: NDArray[np.float64],
    *,
    number: int | None,
    n_offsets: int,
    direct: tuple[NDArray[np.float64], NDArray[np.float64]] | None = None,
    at_rest: tuple[slice, NDArray[np.float64]] | None = None,
) -> Jacobian:
    """Of residuals with derivatives smooth (n, n_dofs) by displacements, these with tangent (n_dofs, k) by unknowns.

    Columns of n_offsets offsets follow, of which that with a `number` is the residuals' own; None: they have none. Some
    of these may be modes (n_dofs, m) mm of the surface `at_rest`.
    """
    ones, (n_dofs, k) = sparse.csr_matrix(np.ones((smooth.shape[0], 1))), tangent.shape
    held = direct or (np.zeros((smooth.shape[0], 0)), np.zeros((0, k)))
    rows = np.zeros((n_dofs + 1 + len(held[1]), k + n_offsets))
    rows[:n_dofs, :k], rows[n_dofs + 1 :, :k] = tangent, held[1]
    if n_offsets and number is not None:
        rows[n_dofs, k + number] = 1.0
    if at_rest is not None:
        which, modes = at_rest
        rows[:n_dofs, k + which.start : k + which.stop] = modes
    return Jacobian(sparse.csr_matrix(sparse.hstack([smooth, ones, sparse.csr_matrix(held[0])], format="csr")), rows)
