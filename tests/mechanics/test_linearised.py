"""Solutions with the factorisation of a similar matrix are those of the matrix itself."""

from __future__ import annotations

from functools import partial

import numpy as np
import pytest
from scipy import sparse

from palpate.errors import SolverError
from palpate.mechanics.linearised import LinearisedSystem, symmetric_part
from palpate.mechanics.solvers.conjugate_gradients import conjugate_gradients, times
from palpate.mechanics.solvers.registry import factorise

N = 60


@pytest.fixture
def matrix(rng):
    """Symmetric positive definite (N, N), tridiagonal."""
    diagonal = rng.uniform(2.5, 4.0, N)
    return sparse.csr_matrix(sparse.diags([-np.ones(N - 1), diagonal, -np.ones(N - 1)], [-1, 0, 1]))


def skew(size):
    return sparse.csr_matrix(sparse.diags([size * np.ones(N - 3), -size * np.ones(N - 3)], [3, -3]))


def test_an_old_factorisation_gives_the_solution_of_the_new_matrix(matrix, rng):
    new = sparse.csr_matrix(matrix + sparse.diags(rng.uniform(0.0, 2.0, N)))
    rhs = rng.standard_normal((N, 4))
    found = LinearisedSystem(new, factorise(matrix), symmetric=True).solve(rhs)
    assert np.allclose(new @ found, rhs, atol=1e-11)


@pytest.mark.parametrize("size", [0.1, 3.0])
def test_the_symmetric_part_serves_an_unsymmetric_matrix_and_its_transpose(matrix, rng, size):
    unsymmetric = sparse.csr_matrix(matrix + skew(size))
    assert abs(symmetric_part(unsymmetric) - matrix).max() < 1e-14
    system = LinearisedSystem(unsymmetric, factorise(symmetric_part(unsymmetric)), symmetric=False)
    rhs = rng.standard_normal((N, 2))
    assert np.allclose(unsymmetric @ system.solve(rhs), rhs, atol=1e-8)
    assert np.allclose(unsymmetric.T @ system.transposed().solve(rhs), rhs, atol=1e-8)


def test_a_singular_matrix_is_refused(matrix):
    singular = sparse.csr_matrix(matrix.multiply(np.arange(N)[:, None] > 0))
    with pytest.raises(SolverError, match="GMRES stopped"):
        LinearisedSystem(singular, factorise(matrix), symmetric=False).solve(np.ones((N, 1)))


def test_conjugate_gradients_refuse_a_direction_without_energy(matrix):
    with pytest.raises(SolverError, match="not positive definite"):
        conjugate_gradients(
            partial(times, -matrix), np.ones((N, 1)), factorise(matrix).solve, tolerance=1e-8, max_iterations=5
        )


def test_conjugate_gradients_say_when_they_did_not_converge(matrix, rng):
    with pytest.raises(SolverError, match="after 2 steps"):
        conjugate_gradients(
            partial(times, matrix), rng.standard_normal((N, 1)), lambda r: r, tolerance=1e-12, max_iterations=2
        )


def test_no_load_needs_no_step(matrix):
    solution, steps = conjugate_gradients(
        partial(times, matrix), np.zeros((N, 2)), factorise(matrix).solve, tolerance=1e-8, max_iterations=5
    )
    assert steps == 0
    assert not solution.any()
