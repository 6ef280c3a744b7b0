"""The direct solvers: single precision refined to its tolerance, double where that fails, memory asked for first."""

from __future__ import annotations

import tracemalloc

import numpy as np
import pytest
from scipy import sparse

from palpate.errors import ResourceError, SolverError
from palpate.mechanics.solvers import direct
from palpate.mechanics.solvers.contract import Hints

NOTHING = Hints()


def chain(n, seed):
    """A positive definite chain of n unknowns with random springs between them, and a weak one to the ground."""
    rng = np.random.default_rng(seed)
    springs = rng.uniform(0.5, 2.0, n - 1)
    diagonal = 0.1 + np.append(springs, 0.0) + np.insert(springs, 0, 0.0)
    return sparse.csr_matrix(sparse.diags_array([-springs, diagonal, -springs], offsets=[-1, 0, 1]))


def filled(n, seed):
    """A positive definite matrix without zeros."""
    root = np.random.default_rng(seed).standard_normal((n, n))
    return sparse.csr_matrix(root @ root.T + np.eye(n))


def relative_residual(matrix, found, rhs):
    return np.max(np.linalg.norm(matrix @ found - rhs, axis=0) / np.linalg.norm(rhs, axis=0))


@pytest.mark.parametrize("matrix", [chain(300, 0), filled(60, 1)], ids=["chain", "full"])
def test_single_precision_is_refined_to_its_tolerance(matrix):
    rhs = np.random.default_rng(2).standard_normal((matrix.shape[0], 3)) * [1.0, 1e-60, 1e60]
    ready = direct.MIXED.factorise(matrix, NOTHING)
    assert relative_residual(matrix, ready.solve(rhs), rhs) < 1e-9


def test_single_precision_alone_is_near_whatever_the_unit():
    large = 1e30 * filled(60, 1)
    ready = direct.MIXED.factorise(large, NOTHING)
    assert isinstance(ready, direct.MixedFactorisation)
    rhs = np.ones((60, 2))
    assert 1e-9 < relative_residual(large, ready.nearly(rhs), rhs) < 1e-2


def test_what_single_precision_cannot_factorise_is_factorised_in_double():
    ends = sparse.diags_array(np.where(np.arange(2001) % 2, 1e5, 1e-1))
    uneven = sparse.csr_matrix(ends @ chain(2001, 9) @ ends)
    ladder = sparse.diags_array([-np.ones(1999), np.full(2000, 2.0), -np.ones(1999)], offsets=[-1, 0, 1]).tocsr()
    for hard in (sparse.csr_matrix(ladder @ ladder), uneven):
        rhs = hard @ np.ones((hard.shape[0], 1))
        assert relative_residual(hard, direct.MIXED.factorise(hard, NOTHING).solve(rhs), rhs) < 1e-9
    ready = direct.MIXED.factorise(sparse.csr_matrix(ladder @ ladder), NOTHING)
    assert isinstance(ready, direct.DirectFactorisation)


def test_an_indefinite_stiffness_is_refused_with_its_pivot():
    with pytest.raises(SolverError, match=r"pivot \d+ of elimination is not positive; hold the body"):
        direct.SOLVER.factorise(chain(50, 3) - sparse.csr_matrix(np.eye(50)), NOTHING)


def test_memory_that_is_not_there_is_refused_before_it_is_taken(environment):
    line = sparse.diags_array([-np.ones(14), np.full(15, 2.1), -np.ones(14)], offsets=[-1, 0, 1])
    matrix = sparse.csr_matrix(
        sparse.kron(sparse.kronsum(line, line), sparse.eye_array(15)) + sparse.kron(sparse.eye_array(225), line)
    )
    needed = direct.SOLVER.expect(matrix, NOTHING).bytes
    environment(PALPATE_MEMORY_GB=f"{0.9e-9 * needed:.6f}")
    tracemalloc.start()
    try:
        with pytest.raises(ResourceError, match=r"3375 unknowns needs [\d.]+ GB and [\d.]+ GB are free"):
            direct.SOLVER.factorise(matrix, NOTHING)
        assert tracemalloc.get_traced_memory()[1] < 0.2 * needed
    finally:
        tracemalloc.stop()
