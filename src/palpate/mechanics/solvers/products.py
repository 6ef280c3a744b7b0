"""Products of a sparse matrix with a few vectors."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

__all__ = ["times"]

FEW = 8  # columns, up to which one after the other is faster: SciPy's kernel for several has no registers for so few


def times(matrix: sparse.csr_matrix[np.float64], vectors: NDArray[np.float64]) -> NDArray[np.float64]:
    """A X (n, k) for A (n, m) and X (m, k), in the unit of their products."""
    if vectors.shape[1] >= FEW:
        return np.asarray(matrix @ vectors)
    result = np.empty((matrix.shape[0], vectors.shape[1]))
    for number, column in enumerate(np.ascontiguousarray(vectors.T)):
        result[:, number] = matrix @ column
    return result
