"""Systems of all unknowns, solved image by image.

A later image has unknowns of its own: how its walls and its frame move, how it is drawn. Unknowns of two images are
coupled through moduli and tissues only. The Gauss-Newton matrix is therefore an arrow: with each image's own unknowns
eliminated, a small system of the shared ones is left, and the cost is linear in the number of images. With a single
image a system is solved as a whole.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Images = tuple[NDArray[np.int64], ...]
"""Numbers (n,) among all unknowns of those that belong to each later image alone."""


def solve_by_image(matrix: NDArray[np.float64], rhs: NDArray[np.float64], images: Images) -> NDArray[np.float64]:
    """Solution (n, k) of a symmetric arrow matrix (n, n) for rhs (n, k).

    With A of the shared unknowns, D_k of image k and B_k between them: x_s = (A - sum_k B_k D_k^-1 B_k^T)^-1 (b_s -
    sum_k B_k D_k^-1 b_k), x_k = D_k^-1 (b_k - B_k^T x_s). Raises `LinAlgError` for a singular matrix.
    """
    if not images:
        return np.asarray(np.linalg.solve(matrix, rhs))
    shared = shared_by(images, len(matrix))
    n, left, right = len(shared), matrix[np.ix_(shared, shared)], rhs[shared]
    followed = []
    for own in images:
        across = matrix[np.ix_(own, shared)]
        answer = np.linalg.solve(matrix[np.ix_(own, own)], np.concatenate([across, rhs[own]], axis=1))
        left, right = left - across.T @ answer[:, :n], right - across.T @ answer[:, n:]
        followed.append(answer)
    found = np.empty_like(rhs, dtype=np.float64)
    found[shared] = of_shared = np.linalg.solve(left, right)
    for own, answer in zip(images, followed, strict=True):
        found[own] = answer[:, n:] - answer[:, :n] @ of_shared
    return found


def log_determinant(matrix: NDArray[np.float64], images: Images) -> float:
    """Ln det of a positive definite arrow matrix (n, n): of each D_k, and of what is left of the shared unknowns."""
    if not images:
        return float(np.linalg.slogdet(matrix)[1])
    shared = shared_by(images, len(matrix))
    left, total = matrix[np.ix_(shared, shared)], 0.0
    for own in images:
        across, block = matrix[np.ix_(own, shared)], matrix[np.ix_(own, own)]
        total += float(np.linalg.slogdet(block)[1])
        left = left - across.T @ np.linalg.solve(block, across)
    return total + float(np.linalg.slogdet(left)[1])


def shared_by(images: Images, n_unknowns: int) -> NDArray[np.int64]:
    """Numbers (n_shared,) of the unknowns that belong to no single image."""
    every = np.ones(n_unknowns, dtype=bool)
    for own in images:
        every[own] = False
    return np.flatnonzero(every)


def among(images: Images, kept: NDArray[np.bool_]) -> Images:
    """The images' unknowns, numbered among those that are `kept` (n_unknowns,)."""
    numbers = np.cumsum(kept) - 1
    return tuple(numbers[own[kept[own]]] for own in images)
