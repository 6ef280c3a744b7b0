"""Smooth modes of a driver wall's motion: the leading terms of a Gaussian process on its nodes."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

__all__ = ["Wall", "kernel_factor", "wall_modes"]

RANK_TOLERANCE = 1e-12


@dataclass(frozen=True, slots=True)
class Wall:
    """One driver's wall and the modes of its motion.

    points (n_points, 3) mm with unit normals (n_points, 3); columns (n_modes,) of the constraint's modes that move it,
    three a scalar mode; scalar (n_points, n_modes / 3) mm: the scalar modes, whose coefficients are N(0, 1) under a
    kernel of `kernel_mm` and a standard deviation of `prior_mm`.
    """

    points: NDArray[np.float64]
    normals: NDArray[np.float64]
    columns: NDArray[np.int64]
    scalar: NDArray[np.float64]
    kernel_mm: float
    prior_mm: float

    def drift(self, kernel_mm: float) -> NDArray[np.float64]:
        """Covariance (n_modes, n_modes) of the coefficients of a motion whose components are alike, `prior_mm` each.

        B^+ K B^+^T for the modes B and a Gaussian kernel K of length `kernel_mm`.
        """
        amounts = np.linalg.lstsq(self.scalar, self._factor(kernel_mm), rcond=None)[0]
        return np.asarray(np.kron(amounts @ amounts.T, np.eye(3)))

    def swelling(self, kernel_mm: float) -> NDArray[np.float64]:
        """Covariance (n_modes, n_modes) of the coefficients of a motion along the normals, of `prior_mm`.

        As `drift` with the kernel n(x) . k(x, y) n(y)^T, what a hollow organ does that fills.
        """
        factor = self._factor(kernel_mm)
        along = [np.linalg.lstsq(self.scalar, self.normals[:, [a]] * factor, rcond=None)[0] for a in range(3)]
        amounts = np.stack(along, axis=1).reshape(len(self.columns), -1)
        return np.asarray(amounts @ amounts.T)

    def _factor(self, kernel_mm: float) -> NDArray[np.float64]:
        rank = min(len(self.points), 4 * self.scalar.shape[1])
        return self.prior_mm * kernel_factor(self.points, kernel_mm, rank)


def wall_modes(points: NDArray[np.float64], *, n_modes: int, kernel_mm: float, prior_mm: float) -> NDArray[np.float64]:
    """Displacement modes of wall points (n_points, 3) mm, as columns (3 n_points, n_modes) mm.

    Each component of the wall's displacement is a Gaussian process with the covariance
    k(x, y) = prior^2 exp(-|x - y|^2 / (2 kernel^2)); the columns are its Karhunen-Loeve modes with their standard
    deviation as length, so that coefficients q ~ N(0, 1) give displacements of that law. n_modes // 3 scalar modes,
    each along x, y and z; the unknown of point p along axis a is row 3 p + a. Fewer columns come back when the kernel
    has no more modes on so small a wall.
    """
    factor = kernel_factor(points, kernel_mm, min(len(points), 4 * (n_modes // 3)))
    left, scale, _ = np.linalg.svd(factor, full_matrices=False)
    keep = min(n_modes // 3, int(np.count_nonzero(scale > RANK_TOLERANCE * scale.max(initial=0.0))))
    scalar = prior_mm * left[:, :keep] * scale[:keep]
    return np.asarray(np.kron(scalar, np.eye(3)))


def kernel_factor(points: NDArray[np.float64], kernel_mm: float, rank: int) -> NDArray[np.float64]:
    """Factor L (n_points, rank) with L L^T close to exp(-|x - y|^2 / (2 kernel^2)) at points (n_points, 3) mm.

    Pivoted Cholesky decomposition, stopped at `rank` or at rounding; Harbrecht, Peters & Schneider 2012, Algorithm 1.
    """
    left = np.ones(len(points))
    factor = np.zeros((len(points), rank))
    for k in range(rank):
        pivot = int(np.argmax(left))
        if left[pivot] < RANK_TOLERANCE:
            return factor[:, :k]
        distance2 = np.sum((points - points[pivot]) ** 2, axis=1)
        column = np.exp(-distance2 / (2.0 * kernel_mm**2)) - factor[:, :k] @ factor[pivot, :k]
        factor[:, k] = column / np.sqrt(left[pivot])
        left = np.maximum(left - factor[:, k] ** 2, 0.0)
    return factor
