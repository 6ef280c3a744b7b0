"""Voxels brought to the axis order closest to RAS; nothing is resampled and the affine stays exact."""

from __future__ import annotations

from itertools import permutations
from typing import Any

import numpy as np
from numpy.typing import NDArray

__all__ = ["to_canonical"]


def to_canonical(values: NDArray[Any], affine: NDArray[np.float64]) -> tuple[NDArray[Any], NDArray[np.float64]]:
    """Re-order and flip the axes of `values` (n_1, n_2, n_3) so that they run to the right, front and head.

    `affine` (4, 4) index -> RAS mm. Of the six axis orders the one with the largest sum of direction cosines wins; a
    tie (a grid turned by 45 degrees) is broken by the resulting matrix, so that the way of storing never matters.
    """
    directions = affine[:3, :3] / np.linalg.norm(affine[:3, :3], axis=0)
    order = max(permutations(range(3)), key=lambda axes: _rank(directions[:, axes]))
    flips = directions[range(3), order] < 0.0
    matrix = affine[:3, :3][:, order] * np.where(flips, -1.0, 1.0)
    last = np.array(values.shape)[list(order)] - 1
    result = np.eye(4)
    result[:3, :3] = matrix
    result[:3, 3] = affine[:3, 3] - matrix @ np.where(flips, last, 0)
    turned = np.flip(values.transpose(order), axis=tuple(np.flatnonzero(flips)))
    return np.ascontiguousarray(turned), result


def _rank(directions: NDArray[np.float64]) -> tuple[float, ...]:
    """Sum of the cosines along the diagonal, then the matrix itself, rounded so that storage noise breaks no tie."""
    diagonal = np.diag(directions)
    upright = directions * np.where(diagonal < 0.0, -1.0, 1.0)
    return (round(float(np.abs(diagonal).sum()), 5), *np.round(upright, 5).ravel().tolist())
