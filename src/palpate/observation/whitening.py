"""Correlated errors made independent, at a cost that is linear in the number of points."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.spatial import cKDTree

__all__ = ["correlation", "whitener"]

NEIGHBOURS = 12
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
        points = groups[together]
        apart = np.linalg.norm(points[:, :, None, :, None] - points[:, None, :, None, :], axis=-1)
        covariance = correlation(apart, length).mean(axis=(3, 4))
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
