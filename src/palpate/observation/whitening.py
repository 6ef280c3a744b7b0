"""Correlated errors made independent, at a cost that is linear in the number of points."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.spatial import cKDTree

__all__ = ["correlation", "whitener"]

NEIGHBOURS = 12
AT_ONCE = 256  # means whose neighbours' distances are taken at once: some 40 MB
GROWTH = 1.15  # of the number of points from block to block
LEAST = 1e-3  # variance of what the neighbours leave open, over its own


def correlation(distance: NDArray[np.float64], length: float) -> NDArray[np.float64]:
    """Correlation exp(-d / length) (n,), of any shape, at distances d (n,) mm; of independent errors for a length of 0.

    It falls at once: errors are never believed to be so smooth that what is finer than them is known without error.
    """
    if length <= 0.0:
        return np.asarray(distance == 0.0, dtype=np.float64)
    return np.asarray(np.exp(-distance / length))


def whitener(groups: NDArray[np.float64], length: float) -> sparse.csr_matrix[np.float64]:
    """Sparse W (n, n), dimensionless, with W C W^T = 1 nearly, for C of the means of errors of variance 1.

    groups (n, k, 3) mm: the points of each mean. Each mean is conditioned on the nearest of those before it, in an
    order that leaves no place out for long (Vecchia, J. R. Statist. Soc. B 50 (1988) 297-312; Katzfuss & Guinness,
    Statist. Sci. 36 (2021) 124-141).
    """
    n, centres = len(groups), groups.mean(axis=1)
    order = np.random.default_rng(0).permutation(n)
    rows, columns, values = list[NDArray[np.int64]](), list[NDArray[np.int64]](), list[NDArray[np.float64]]()
    start = 0
    while start < n:  # all of a block are conditioned on what lies before the block
        end = min(int(GROWTH * start) + 1, n)
        block, k = order[start:end], min(NEIGHBOURS, start)
        near = np.zeros((len(block), 0), dtype=np.int64)
        if k:
            tree = cKDTree(centres[order[:start]])
            near = order[:start][tree.query(centres[block], k=k)[1].reshape(len(block), k)]
        together = np.concatenate([near, block[:, None]], axis=1)
        covariance = np.concatenate([_covariance(groups[part], length) for part in _parts(together)])
        across, own = covariance[:, :k, k:], covariance[:, k, k]
        weights = np.linalg.solve(covariance[:, :k, :k] + 1e-10 * np.eye(k), across)[:, :, 0]
        left = np.maximum(own - np.einsum("nk,nk->n", weights, across[:, :, 0]), LEAST * own)
        scaled = np.concatenate([-weights, np.ones((len(block), 1))], axis=1) / np.sqrt(left)[:, None]
        rows.append(np.repeat(block, k + 1))
        columns.append(together.ravel())
        values.append(scaled.ravel())
        start = end
    entries = (np.concatenate(values), (np.concatenate(rows), np.concatenate(columns)))
    return sparse.csr_matrix(entries, shape=(n, n))


def _parts(together: NDArray[np.int64]) -> list[NDArray[np.int64]]:
    """Rows (n, k) of numbers in parts of at most `AT_ONCE` rows: the distances of all at once would take gigabytes."""
    return [together[start : start + AT_ONCE] for start in range(0, len(together), AT_ONCE)]


def _covariance(points: NDArray[np.float64], length: float) -> NDArray[np.float64]:
    """Covariance (n, k, k) of the means of groups of points (n, k, m, 3) mm whose errors have the variance 1.

    Squared distances are |x|^2 + |y|^2 - 2 x.y about the middle of the points.
    """
    n, k, m, _ = points.shape
    flat = points.reshape(n, k * m, 3)
    flat = flat - flat.mean(axis=1, keepdims=True)
    squares = np.einsum("npi,npi->np", flat, flat)
    apart = squares[:, :, None] + squares[:, None, :] - 2.0 * flat @ np.swapaxes(flat, 1, 2)
    same = np.arange(k * m)
    apart[:, same, same] = 0.0
    distance = np.sqrt(np.maximum(apart, 0.0))
    return np.asarray(correlation(distance, length).reshape(n, k, m, k, m).mean(axis=(2, 4)))
