"""Preconditioned conjugate gradients for many right-hand sides at once, and products of a matrix with all of them."""

from __future__ import annotations

from collections.abc import Callable
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from palpate.errors import SolverError
from palpate.mechanics.solvers.contract import together
from palpate.parallel import mapped, processors

WORTH_THREADS = 3_000_000  # multiplications, above which threads save time
PART = 2**20  # bytes of a product that is computed at once; the system would fill larger arrays with zeros first
ROOM = 2**27  # bytes for the vectors of all columns that are iterated together
VECTORS = 8  # vectors for each column
FEWEST = 32  # columns; products of a factor with fewer are slow

Product = Callable[[NDArray[np.float64]], NDArray[np.float64]]  # of a matrix (n, n) with vectors (n, k)


def times(matrix: sparse.csr_matrix[np.float64], vectors: NDArray[np.float64]) -> NDArray[np.float64]:
    """A X (n, k) for A (n, m) and X (m, k), in the unit of their products."""
    if matrix.nnz * vectors.shape[1] < WORTH_THREADS:
        return np.asarray(matrix @ vectors)
    by_rows, found = np.ascontiguousarray(vectors), np.empty((matrix.shape[0], vectors.shape[1]))

    def rows(part: tuple[int, int]) -> None:
        """Those of the product from the first to before the last."""
        begin, end = part
        entries = slice(int(matrix.indptr[begin]), int(matrix.indptr[end]))
        own = sparse.csr_matrix((end - begin, matrix.shape[1]))  # which would copy the entries, were it made of them
        own.data, own.indices = matrix.data[entries], matrix.indices[entries]
        own.indptr = matrix.indptr[begin : end + 1] - matrix.indptr[begin]
        found[begin:end] = np.asarray(own @ by_rows)

    share_of = np.linspace(0, matrix.nnz, max(processors(), found.nbytes // PART) + 1)[1:-1]
    ends = [0, *np.searchsorted(matrix.indptr, share_of).tolist(), matrix.shape[0]]
    mapped(rows, pairwise(ends))
    return found


def column_norms(vectors: NDArray[np.float64]) -> NDArray[np.float64]:
    """Lengths (k,) of columns (n, k), in their unit; NumPy's own norm takes thirty times as long."""
    return np.asarray(np.sqrt(np.einsum("ij,ij->j", vectors, vectors)))


def conjugate_gradients(
    product: Product,
    rhs: NDArray[np.float64],
    precondition: Product,
    *,
    tolerance: float | NDArray[np.float64],
    max_iterations: int,
) -> tuple[NDArray[np.float64], int]:
    """Solution X (n, m) of A X = rhs (n, m), one iteration for each column but all products at once; and how many.

    product maps X (n, k) to A X, precondition residuals (n, k) to nearly A^-1 times them; tolerance, one or (m,), is of
    the relative residual.
    Hestenes & Stiefel, J. Res. NBS 49 (1952) 409-436. Columns are taken together as far as their vectors have room.
    Raises `SolverError` for a direction of no positive energy and when the tolerance is not met.
    """
    tolerances = np.broadcast_to(np.asarray(tolerance, dtype=np.float64), rhs.shape[1:])
    parts = together(*rhs.shape, room=ROOM // VECTORS, fewest=FEWEST)
    if len(parts) > 1:
        found = [
            conjugate_gradients(
                product, rhs[:, part], precondition, tolerance=tolerances[part], max_iterations=max_iterations
            )
            for part in parts
        ]
        return np.concatenate([solution for solution, _ in found], axis=1), max(number for _, number in found)
    norms = column_norms(rhs)
    limits = tolerances * norms
    solution = np.zeros_like(rhs)
    active = np.flatnonzero(norms > 0.0)
    if len(active) == 0:
        return solution, 0
    residual = rhs[:, active].copy()
    direction = precondition(residual)
    remaining = np.einsum("ij,ij->j", residual, direction)
    for number in range(1, max_iterations + 1):
        image = product(direction)
        energy = np.einsum("ij,ij->j", direction, image)
        if not np.all(energy > 0.0):
            raise SolverError(
                f"the stiffness of {len(rhs)} unknowns is not positive definite: a direction has the energy"
                f" {np.min(energy):.3g}; hold the body somewhere and check for inverted tetrahedra"
            )
        alpha = remaining / energy
        image *= alpha
        residual -= image
        running = column_norms(residual) > limits[active]
        if len(active) == len(norms):
            solution += alpha * direction
        else:
            solution[:, active] += alpha * direction
        if not running.any():
            return solution, number
        if not running.all():
            active, residual, direction = active[running], residual[:, running], direction[:, running]
        preconditioned = precondition(residual)
        following = np.einsum("ij,ij->j", residual, preconditioned)
        direction *= following / remaining[running]
        direction += preconditioned
        remaining = following
    worst = float(np.max(column_norms(residual) / norms[active]))
    raise SolverError(
        f"conjugate gradients stopped at a relative residual of {worst:.2g} (tolerance {tolerances.min():g}) after"
        f" {max_iterations} steps for {len(rhs)} unknowns: use the direct solver ('multifrontal') or a Poisson's"
        " ratio further from 0.5"
    )
