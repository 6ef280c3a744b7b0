"""Smooth modes of a driver wall's motion: the leading terms of a Gaussian process on its nodes."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from palpate.mesh.gaussian_process import RANK_TOLERANCE, karhunen_loeve, kernel_factor

DRIFT_LENGTHS = (1.0, 4.0)  # times the kernel of the modes, which sets the shortest length
SWELLING_LENGTHS = (1.0, 2.0)
FINE_KERNEL_MM, FINE_MM = 8.0, 0.3  # of what a wall does on a finer scale than its modes
FINE_SHARE, FINE_MODES = 0.95, 150  # of its variance; number of modes at the most


@dataclass(frozen=True, slots=True)
class Wall:
    """How one driver's wall may move: covariances (n_modes, n_modes) of its modes' coefficients, dimensionless.

    name: the driver's; columns (n_modes,): the constraint's modes that move it, n_fine more follow them; `drifts`: of
    motions whose components are alike, one for each of `DRIFT_LENGTHS`; `swellings`: of motions along the normals, one
    for each of `SWELLING_LENGTHS`. All have the modes' own standard deviation.
    """

    name: str
    columns: NDArray[np.int64]
    n_fine: int
    drifts: tuple[NDArray[np.float64], ...]
    swellings: tuple[NDArray[np.float64], ...]


def wall_of(
    points: NDArray[np.float64],
    normals: NDArray[np.float64],
    modes: NDArray[np.float64],
    columns: NDArray[np.int64],
    *,
    name: str,
    n_fine: int = 0,
    kernel_mm: float,
    prior_mm: float,
) -> Wall:
    """The wall of points (n_points, 3) mm and unit normals (n_points, 3) that `wall_modes` (3 n_points, n_modes) move.

    Covariances B^+ K B^+^T for the modes B and a Gaussian process K of standard deviation prior_mm: k(x, y) 1 of a
    drift and n(x) k(x, y) n(y)^T of a swelling, what a hollow organ does that fills, k with a multiple of kernel_mm.
    """
    scalar = modes[::3, ::3]
    rank = min(len(points), 4 * scalar.shape[1])
    factors = {m: prior_mm * kernel_factor(points, m * kernel_mm, rank) for m in {*DRIFT_LENGTHS, *SWELLING_LENGTHS}}
    inverse = np.linalg.pinv(scalar)
    drifts = [inverse @ factors[multiple] for multiple in DRIFT_LENGTHS]
    swellings = [
        np.stack([inverse @ (normals[:, [axis]] * factors[multiple]) for axis in range(3)], axis=1)
        for multiple in SWELLING_LENGTHS
    ]
    along = [amounts.reshape(len(columns), -1) for amounts in swellings]
    return Wall(
        name,
        columns,
        n_fine,
        tuple(np.asarray(np.kron(a @ a.T, np.eye(3))) for a in drifts),
        tuple(np.asarray(a @ a.T) for a in along),
    )


def fine_modes(points: NDArray[np.float64], normals: NDArray[np.float64]) -> NDArray[np.float64]:
    """Modes (3 n_points, k) mm of what a wall does on a finer scale, along its unit normals (n_points, 3).

    Karhunen-Loeve modes of a Gaussian process with a kernel of `FINE_KERNEL_MM` and a standard deviation of
    `FINE_MM` on points (n_points, 3) mm.
    """
    scalar = karhunen_loeve(points, np.ones(len(points)), kernel_mm=FINE_KERNEL_MM, share=FINE_SHARE, most=FINE_MODES)
    along = normals[:, :, None] * scalar[:, None, :]
    return np.asarray(FINE_MM * along.reshape(3 * len(points), scalar.shape[1]))


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
