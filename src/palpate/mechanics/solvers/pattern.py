"""Structure of a sparse matrix: which neighbouring unknowns belong to one node."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

__all__ = ["twin_rows"]


def twin_rows(matrix: sparse.csr_matrix[np.float64]) -> NDArray[np.int64]:
    """Group number (n,), from 0 upwards, of each row; neighbouring rows with the same columns are in one group.

    The three unknowns of a node are such twins, and so are the two of a node that slides on a plane. Two patterns are
    compared by the sum of random 64-bit numbers of their columns: a chance of 2^-64 a row to be wrong, which would
    cost speed, not correctness.
    """
    tickets = np.random.default_rng(0).integers(-(2**62), 2**62, size=matrix.shape[1])
    entries = np.append(tickets[matrix.indices], 0)
    sums = np.add.reduceat(entries, matrix.indptr[:-1])
    lengths = np.diff(matrix.indptr)
    different = (np.diff(sums) != 0) | (np.diff(lengths) != 0) | (lengths[1:] == 0)
    return np.concatenate([[0], np.cumsum(different)])
