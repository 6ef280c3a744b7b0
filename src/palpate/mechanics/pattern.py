"""Where the blocks of elements go in a sparse matrix: found once, used at every Newton step."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from palpate.mechanics.solvers.conjugate_gradients import times
from palpate.mesh.space import Constraint

Stiffness: TypeAlias = "sparse.bsr_matrix[np.float64] | sparse.csr_matrix[np.float64]"  # in blocks of points, or not


@dataclass(frozen=True, slots=True)
class BlockPattern:
    """Places of the 3 x 3 blocks of cells (n_cells, n_a) in a matrix of n_points points.

    gather (n_blocks, n_cells * n_a * n_a): which element blocks a block of the matrix sums; indices (n_blocks,) and
    indptr (n_points + 1,) are the block matrix' own.
    """

    gather: sparse.csr_matrix[np.float64]
    indices: NDArray[np.int64]
    indptr: NDArray[np.int64]

    def assemble(self, blocks: NDArray[np.float64]) -> sparse.bsr_matrix[np.float64]:
        """Matrix (3 n_points, 3 n_points), mN/mm, of element blocks (n_cells * n_a * n_a, 9) mN/mm."""
        data = times(self.gather, blocks).reshape(-1, 3, 3)
        size = 3 * (len(self.indptr) - 1)
        return sparse.bsr_matrix((data, self.indices, self.indptr), shape=(size, size))


def block_pattern(cells: NDArray[np.int64], n_points: int) -> BlockPattern:
    """Pattern of cells (n_cells, n_a), numbers of points."""
    keys = (cells[:, :, None] * n_points + cells[:, None, :]).ravel()
    order = np.argsort(keys, kind="stable")
    ordered = keys[order]
    first = np.flatnonzero(np.diff(ordered, prepend=-1))
    unique = ordered[first]
    # A 0/1 matrix times the blocks sums them without a sorted copy of all of them.
    starts = np.append(first, len(order))
    gather = sparse.csr_matrix((np.ones(len(order)), order, starts), shape=(len(unique), len(order)))
    return BlockPattern(gather, unique % n_points, np.searchsorted(unique, np.arange(n_points + 1) * n_points))


@dataclass(frozen=True, slots=True)
class Restriction:
    """From a matrix K (n_dof, n_dof) of blocks to F^T K F: by `places` (nnz,) of its entries where F only selects."""

    free: sparse.csr_matrix[np.float64]
    places: NDArray[np.int32] | None
    indices: NDArray[np.int32]
    indptr: NDArray[np.int32]

    def of(self, matrix: sparse.bsr_matrix[np.float64]) -> sparse.csr_matrix[np.float64]:
        """F^T K F (n_free, n_free), mN/mm, of a matrix K (n_dof, n_dof) with the pattern that this was made for."""
        n = self.free.shape[1]
        if self.places is None:
            return restricted(sparse.csr_matrix(matrix), self.free)
        return sparse.csr_matrix((matrix.data.ravel()[self.places], self.indices, self.indptr), shape=(n, n))


def restriction(constraint: Constraint, pattern: sparse.bsr_matrix[np.float64]) -> Restriction:
    """Restriction to the free displacements of `constraint`, for matrices with the blocks of `pattern` (n, n)."""
    free, empty = constraint.free, np.zeros(0, dtype=np.int32)
    selected = selection(free)
    if selected is None:
        return Restriction(free, None, empty, empty)
    numbers = np.arange(pattern.nnz, dtype=np.int32).reshape(pattern.data.shape)
    numbered = sparse.bsr_matrix((numbers, pattern.indices, pattern.indptr), shape=pattern.shape).tocsr()
    chosen = sparse.csr_matrix(numbered[selected][:, selected])
    chosen.sort_indices()
    return Restriction(free, np.asarray(chosen.data), chosen.indices, chosen.indptr)


def selection(free: sparse.csr_matrix[np.float64]) -> NDArray[np.int32] | None:
    """Numbers (n_free,) of the displacements that F (n_dof, n_free) selects; None where it combines some."""
    columns = free.tocsc()
    selects = np.all(np.diff(columns.indptr) == 1) and np.all(columns.data == 1.0)
    return np.asarray(columns.indices) if selects else None


def restricted(
    matrix: sparse.csr_matrix[np.float64], free: sparse.csr_matrix[np.float64]
) -> sparse.csr_matrix[np.float64]:
    """F^T K F (n_free, n_free), mN/mm, of a matrix K (n_dof, n_dof); where F only selects with entries that are zero.

    Matrices of one body so have one pattern, under each law, and one plan of the solver's.
    """
    selected = selection(free)
    product = free.T @ matrix @ free if selected is None else matrix[selected][:, selected]
    found = sparse.csr_matrix(product)
    found.sort_indices()
    return found
