"""Conjugate gradients with multigrid: memory grows linearly, for meshes too large to factorise.

Quadratic elements come first down to the linear ones on the same mesh, those by smoothed aggregation.

Vanek, Mandel & Brezina, Computing 56 (1996) 179-196; the hierarchy is built by PyAMG, the cycle and the iteration
work on all right-hand sides at once so that each level's matrix is read once for all of them.
"""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from functools import partial

import numpy as np
from numpy.typing import NDArray
from scipy import linalg, sparse

from multifrontal import twin_rows
from palpate.errors import SolverError
from palpate.mechanics.solvers.conjugate_gradients import conjugate_gradients, times
from palpate.mechanics.solvers.contract import EXACT, Expectation, Factorisation, Hints, Solver

MAX_ITERATIONS = 2000
SMOOTHER_DEGREE = 3
# Measured on one thread of a 2.4 GHz AMD EPYC: seconds for each entry of the matrix for the set-up, and for each step
# of one right-hand side, alone or among several; steps at nu 0.49 and moduli of 50 to 1 (20 at nu 0.45 and 4 to 1).
SET_UP = 5e-8
STEP_ALONE, STEP_OF_MANY = 7.3e-9, 3.4e-9
STEPS = 60
BYTES_AN_ENTRY = 30.0  # for each entry of the matrix, all levels together
ENTRIES = 81.0  # of the stiffness of quadratic tetrahedra, for each unknown
SMOOTHED_SHARE = 20.0  # the smoother damps the eigenvalues between their largest / SMOOTHED_SHARE and their largest


@dataclass(frozen=True, slots=True)
class Level:
    """One grid: its matrix (n, n), 1 / its diagonal (n, 1), the largest eigenvalue of their product, the ways."""

    matrix: sparse.csr_matrix[np.float64]
    inverse_diagonal: NDArray[np.float64]
    largest: float
    prolongation: sparse.csr_matrix[np.float64]
    restriction: sparse.csr_matrix[np.float64]

    def smooth(self, rhs: NDArray[np.float64], start: NDArray[np.float64] | None = None) -> NDArray[np.float64]:
        """Chebyshev iteration for A X = rhs from `start` (n, m), or from zero: Saad 2003, algorithm 12.1."""
        upper, lower = 1.1 * self.largest, self.largest / SMOOTHED_SHARE
        centre, half = 0.5 * (upper + lower), 0.5 * (upper - lower)
        rho = half / centre
        solution = np.zeros_like(rhs) if start is None else start
        residual = rhs if start is None else rhs - times(self.matrix, solution)
        step = self.inverse_diagonal * residual / centre
        for _ in range(SMOOTHER_DEGREE - 1):
            solution = solution + step
            following = 1.0 / (2.0 * centre / half - rho)
            residual = self.inverse_diagonal * (rhs - times(self.matrix, solution))
            step = following * rho * step + 2.0 * following / half * residual
            rho = following
        return np.asarray(solution + step)


@dataclass(frozen=True, slots=True)
class MultigridFactorisation:
    """The levels from fine to coarse and the Cholesky factor of the coarsest matrix."""

    matrix: sparse.csr_matrix[np.float64]
    levels: tuple[Level, ...]
    coarsest: tuple[NDArray[np.float64], bool]

    def cycle(self, rhs: NDArray[np.float64], level: int = 0) -> NDArray[np.float64]:
        """One V-cycle for A X = rhs (n, m), symmetric: a preconditioner for conjugate gradients."""
        if level == len(self.levels):
            return np.asarray(linalg.cho_solve(self.coarsest, rhs))
        here = self.levels[level]
        solution = here.smooth(rhs)
        residual = times(here.restriction, rhs - times(here.matrix, solution))
        return here.smooth(rhs, solution + times(here.prolongation, self.cycle(residual, level + 1)))

    def solve(self, rhs: NDArray[np.float64], *, tolerance: float = EXACT) -> NDArray[np.float64]:
        """Solution X (n, m) of A X = rhs (n, m) to a relative residual of `tolerance`; raises `SolverError`."""
        steps = MAX_ITERATIONS
        return conjugate_gradients(
            partial(times, self.matrix), rhs, self.cycle, tolerance=tolerance, max_iterations=steps
        )[0]

    nearly = solve


def _factorise(matrix: sparse.csr_matrix[np.float64], hints: Hints) -> Factorisation:
    if hints.coarser is None:
        return _aggregated(matrix, hints.near_nullspace)
    down = hints.coarser.prolongation
    inner = sparse.csr_matrix(down.T @ sparse.csr_matrix(matrix @ down))
    inner.sort_indices()
    near_nullspace = None if hints.near_nullspace is None else hints.near_nullspace[hints.coarser.kept]
    below = _aggregated(inner, near_nullspace)
    return MultigridFactorisation(matrix, (_level(matrix, down), *below.levels), below.coarsest)


def _aggregated(
    matrix: sparse.csr_matrix[np.float64], near_nullspace: NDArray[np.float64] | None
) -> MultigridFactorisation:
    """The levels by smoothed aggregation."""
    import pyamg  # noqa: PLC0415 - a tenth of a second that no other solver need spend

    n = matrix.shape[0]
    twins = np.bincount(twin_rows(matrix))
    whole_nodes = n % 3 == 0 and bool(np.all(twins == 3))
    grid = sparse.bsr_matrix(matrix, blocksize=(3, 3)) if whole_nodes else matrix
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # PyAMG comments on its conversions
        hierarchy = pyamg.smoothed_aggregation_solver(
            grid,
            B=near_nullspace,
            smooth=("jacobi", {"omega": 4.0 / 3.0}),
            presmoother=None,
            postsmoother=None,
            max_coarse=1000,
            keep=False,
        )
    try:
        coarsest = linalg.cho_factor(hierarchy.levels[-1].A.toarray(), lower=True)
    except linalg.LinAlgError as error:
        raise SolverError(
            f"the stiffness of {n} unknowns is not positive definite on the coarsest grid ({error}): hold the body"
            " somewhere and check for inverted tetrahedra"
        ) from error
    levels = tuple(_level(level.A, level.P) for level in hierarchy.levels[:-1])
    return MultigridFactorisation(matrix, levels, coarsest)


def _level(matrix: sparse.csr_matrix[np.float64], prolongation: sparse.csr_matrix[np.float64]) -> Level:
    rows = sparse.csr_matrix(matrix)
    inverse = 1.0 / rows.diagonal()[:, None]
    vector = np.random.default_rng(0).standard_normal((rows.shape[0], 1))
    largest = 0.0
    for _ in range(20):  # power iteration; the smoother's margin of a tenth covers what is missing
        vector = inverse * times(rows, vector / np.linalg.norm(vector))
        largest = float(np.linalg.norm(vector))
    up = sparse.csr_matrix(prolongation)
    return Level(rows, inverse, largest, up, sparse.csr_matrix(up.T))


def _expect_of_size(unknowns: int, right_hand_sides: int, entries: float | None = None) -> Expectation:
    entries = ENTRIES * unknowns if entries is None else entries
    a_step = STEP_ALONE if right_hand_sides == 1 else STEP_OF_MANY
    seconds = entries * (SET_UP + STEPS * right_hand_sides * a_step)
    return Expectation(seconds, entries * BYTES_AN_ENTRY + 40.0 * unknowns * right_hand_sides)


SOLVER = Solver(
    "multigrid",
    _factorise,
    False,
    lambda matrix, hints: _expect_of_size(matrix.shape[0], hints.right_hand_sides, matrix.nnz),
    _expect_of_size,
)
