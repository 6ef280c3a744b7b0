"""Products of a sparse matrix with vectors, by all processors where that pays."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from palpate.parallel import mapped, processors

FEW = 8  # columns, up to which one after the other is faster: SciPy's kernel for several has no registers for so few
WORTH_THREADS = 3_000_000  # products; below, handing them to a thread takes longer than it spares


def times(matrix: sparse.csr_matrix[np.float64], vectors: NDArray[np.float64]) -> NDArray[np.float64]:
    """A X (n, k) for A (n, m) and X (m, k), in the unit of their products."""
    number = vectors.shape[1]
    if 0 < number < FEW:
        share = mapped if matrix.nnz >= WORTH_THREADS and number > 1 else map
        return np.stack(list(share(matrix.dot, np.ascontiguousarray(vectors.T))), axis=1)
    if matrix.nnz * number < WORTH_THREADS or processors() == 1:
        return np.asarray(matrix @ vectors)
    together = np.ascontiguousarray(vectors)

    def rows(part: tuple[int, int]) -> NDArray[np.float64]:
        """Those of the product from the first to before the last."""
        begin, end = part
        entries = slice(int(matrix.indptr[begin]), int(matrix.indptr[end]))
        places = matrix.indptr[begin : end + 1] - matrix.indptr[begin]
        own = (matrix.data[entries], matrix.indices[entries], places)
        return np.asarray(sparse.csr_matrix(own, shape=(end - begin, matrix.shape[1])) @ together)

    share_of = np.linspace(0, matrix.nnz, processors() + 1)[1:-1]
    ends = [0, *np.searchsorted(matrix.indptr, share_of).tolist(), matrix.shape[0]]
    return np.concatenate(mapped(rows, pairwise(ends)))
