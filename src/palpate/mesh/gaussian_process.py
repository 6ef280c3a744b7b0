"""Gaussian processes on points of a mesh: low-rank factors and Karhunen-Loeve modes of a Gaussian kernel."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray
from scipy import linalg

RANK_TOLERANCE = 1e-12
Kernel = Callable[[NDArray[np.float64]], NDArray[np.float64]]
RANK = 400  # least number of columns of a factor whose leading modes are sought


def gaussian(squares: NDArray[np.float64]) -> NDArray[np.float64]:
    """exp(-s / 2) (n,) of squares s (n,) of distances over the kernel's length: a field smooth to all orders."""
    return np.asarray(np.exp(-0.5 * squares))


def matern(squares: NDArray[np.float64]) -> NDArray[np.float64]:
    """(1 + d) exp(-d) (n,) with d^2 = 3 s of squares s (n,) of distances over the length: a field with a derivative.

    Matern's kernel with nu = 3/2 (Rasmussen & Williams 2006, equation 4.17).
    """
    distance = np.sqrt(3.0 * squares)
    return np.asarray((1.0 + distance) * np.exp(-distance))


def kernel_factor(
    points: NDArray[np.float64],
    kernel_mm: float,
    rank: int,
    *,
    tolerance: float = RANK_TOLERANCE,
    kernel: Kernel = gaussian,
) -> NDArray[np.float64]:
    """Factor L (n_points, rank) with L L^T close to the kernel's matrix at points (n_points, 3) mm.

    Pivoted Cholesky decomposition, stopped at `rank` or where no variance exceeds the tolerance (Harbrecht, Peters &
    Schneider 2012, Algorithm 1).
    """
    left = np.ones(len(points))
    factor = np.zeros((len(points), rank))
    for k in range(rank):
        pivot = int(np.argmax(left))
        if left[pivot] < tolerance:
            return factor[:, :k]
        distance2 = np.sum((points - points[pivot]) ** 2, axis=1)
        column = kernel(distance2 / kernel_mm**2) - factor[:, :k] @ factor[pivot, :k]
        factor[:, k] = column / np.sqrt(left[pivot])
        left = np.maximum(left - factor[:, k] ** 2, 0.0)
    return factor


def karhunen_loeve(
    points: NDArray[np.float64],
    weights: NDArray[np.float64],
    *,
    kernel_mm: float,
    share: float,
    most: int,
    kernel: Kernel = gaussian,
) -> NDArray[np.float64]:
    """Modes (n_points, k) of a Gaussian process of variance 1 at points (n_points, 3) mm, each with its own amplitude.

    Coefficients N(0, 1) give a field of that law but for what is left out: so many leading modes, `most` at the most,
    hold a `share` of its variance summed with weights (n_points,). Where W = diag(weights) and L L^T is the kernel, the
    eigenvectors V of L^T W L give the modes L V (Ghanem & Spanos 1991, section 2.3).
    """
    if not len(points):
        return np.zeros((0, 0))
    factor = kernel_factor(
        points, kernel_mm, min(len(points), max(RANK, most)), tolerance=0.1 * (1.0 - share), kernel=kernel
    )
    sizes, vectors = linalg.eigh(factor.T @ (weights[:, None] * factor), check_finite=False)
    held = np.cumsum(sizes[::-1]) / float(weights.sum())
    keep = min(int(np.searchsorted(held, share)) + 1, most, len(sizes))
    return np.asarray(factor @ vectors[:, ::-1][:, :keep])
