"""Gaussian processes on points of a mesh: low-rank factors and Karhunen-Loeve modes of a Gaussian kernel."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy import linalg

__all__ = ["RANK_TOLERANCE", "karhunen_loeve", "kernel_factor"]

RANK_TOLERANCE = 1e-12
RANK = 400  # of a factor whose leading modes are sought, at the most


def kernel_factor(
    points: NDArray[np.float64], kernel_mm: float, rank: int, *, tolerance: float = RANK_TOLERANCE
) -> NDArray[np.float64]:
    """Factor L (n_points, rank) with L L^T close to exp(-|x - y|^2 / (2 kernel^2)) at points (n_points, 3) mm.

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
        column = np.exp(-distance2 / (2.0 * kernel_mm**2)) - factor[:, :k] @ factor[pivot, :k]
        factor[:, k] = column / np.sqrt(left[pivot])
        left = np.maximum(left - factor[:, k] ** 2, 0.0)
    return factor


def karhunen_loeve(
    points: NDArray[np.float64], weights: NDArray[np.float64], *, kernel_mm: float, share: float, most: int
) -> NDArray[np.float64]:
    """Modes (n_points, k) of a Gaussian process of variance 1 at points (n_points, 3) mm, each with its own amplitude.

    Coefficients N(0, 1) give a field of that law but for what is left out: so many leading modes, `most` at the most,
    hold a `share` of its variance summed with weights (n_points,). Where W = diag(weights) and L L^T is the kernel, the
    eigenvectors V of L^T W L give the modes L V (Ghanem & Spanos 1991, section 2.3).
    """
    if not len(points):
        return np.zeros((0, 0))
    factor = kernel_factor(points, kernel_mm, min(len(points), RANK), tolerance=0.1 * (1.0 - share))
    sizes, vectors = linalg.eigh(factor.T @ (weights[:, None] * factor), check_finite=False)
    held = np.cumsum(sizes[::-1]) / float(weights.sum())
    keep = min(int(np.searchsorted(held, share)) + 1, most, len(sizes))
    return np.asarray(factor @ vectors[:, ::-1][:, :keep])
