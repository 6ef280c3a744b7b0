"""Cholesky factors of small dense matrices, by kernels that let other threads compute meanwhile.

LAPACK is called as it is: of small matrices what SciPy checks and copies first takes most of the time, and its wrappers
keep Python's lock.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from multifrontal import dense


def lower_factor(matrix: NDArray[np.float64]) -> NDArray[np.float64]:
    """L (n, n), lower, of a symmetric A = L L^T (n, n); raises `LinAlgError` where A is not positive definite."""
    if not len(matrix):
        return matrix
    factor = np.array(matrix.T, order="F")  # its own transpose is taken without turning it
    failed = dense.factor(factor)
    if failed:
        raise np.linalg.LinAlgError(f"the leading {failed} of {len(matrix)} unknowns are not determined")
    return np.triu(factor.T).T  # in the order in which LAPACK reads it


def forward(factor: NDArray[np.float64], rhs: NDArray[np.float64]) -> NDArray[np.float64]:
    """L^-1 b (n,) or (n, k) of a lower factor L (n, n) and b (n,) or (n, k)."""
    found, columns = _columns(rhs)
    if rhs.size:
        dense.solve(np.asfortranarray(factor), columns)
    return found


def backward(factor: NDArray[np.float64], rhs: NDArray[np.float64]) -> NDArray[np.float64]:
    """L^-T b (n,) or (n, k) of a lower factor L (n, n) and b (n,) or (n, k)."""
    found, columns = _columns(rhs)
    if rhs.size:
        dense.solve_adjoint(np.asfortranarray(factor), columns)
    return found


def adjoint_product(factor: NDArray[np.float64], values: NDArray[np.float64]) -> NDArray[np.float64]:
    """L^T b (n, k) of a lower factor L (n, n) and b (n, k)."""
    found, columns = _columns(values)
    if values.size:
        dense.multiply_adjoint(np.asfortranarray(factor), columns)
    return found


def _columns(values: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """A copy of values (n,) or (n, k) in Fortran's order, and its view (n, k)."""
    found = np.array(values, dtype=np.float64, order="F")
    return found, found if found.ndim == 2 else found[:, None]
