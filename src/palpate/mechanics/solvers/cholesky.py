"""Cholesky factors of small dense matrices.

LAPACK is called as it is: of small matrices what SciPy checks and copies first takes most of the time.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy import linalg


def lower_factor(matrix: NDArray[np.float64]) -> NDArray[np.float64]:
    """L (n, n), lower, of a symmetric A = L L^T (n, n); raises `LinAlgError` where A is not positive definite."""
    if not len(matrix):
        return matrix
    factor, failed = linalg.lapack.dpotrf(matrix.T, lower=1, clean=1)  # its own transpose is taken without a copy
    if failed:
        raise np.linalg.LinAlgError(f"the leading {failed} of {len(matrix)} unknowns are not determined")
    return np.asarray(factor)


def forward(factor: NDArray[np.float64], rhs: NDArray[np.float64]) -> NDArray[np.float64]:
    """L^-1 b (n,) or (n, k) of a lower factor L (n, n) and b (n,) or (n, k)."""
    return np.asarray(linalg.lapack.dtrtrs(factor, rhs, lower=1)[0]) if rhs.size else rhs


def backward(factor: NDArray[np.float64], rhs: NDArray[np.float64]) -> NDArray[np.float64]:
    """L^-T b (n,) or (n, k) of a lower factor L (n, n) and b (n,) or (n, k)."""
    return np.asarray(linalg.lapack.dtrtrs(factor, rhs, lower=1, trans=1)[0]) if rhs.size else rhs
