"""Products of a sparse matrix with a few vectors."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from palpate.parallel import mapped

__all__ = ["times"]

FEW = 8  # columns, up to which one after the other is faster: SciPy's kernel for several has no registers for so few
WORTH_THREADS = 3_000_000  # products of a column; below, handing it to a thread takes longer than it spares


def times(matrix: sparse.csr_matrix[np.float64], vectors: NDArray[np.float64]) -> NDArray[np.float64]:
    """A X (n, k) for A (n, m) and X (m, k), in the unit of their products."""
    if not 0 < vectors.shape[1] < FEW:
        return np.asarray(matrix @ vectors)
    share = mapped if matrix.nnz >= WORTH_THREADS and vectors.shape[1] > 1 else map
    return np.stack(list(share(matrix.dot, np.ascontiguousarray(vectors.T))), axis=1)
