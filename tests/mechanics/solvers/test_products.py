"""A product with vectors is the product, by however many threads."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy import sparse

from palpate.mechanics.solvers.conjugate_gradients import WORTH_THREADS, times


@pytest.mark.parametrize("n_columns", [0, 1, 3, 13])
@pytest.mark.parametrize("order", ["C", "F"])
def test_it_is_that_of_the_dense_matrix(n_columns, order):
    rng = np.random.default_rng(2)
    matrix = sparse.csr_matrix(sparse.random_array((30, 20), density=0.3, rng=rng))
    vectors = np.asarray(rng.standard_normal((20, n_columns)), order=order)
    found = times(matrix, vectors)
    assert found.shape == (30, n_columns)
    assert np.allclose(found, matrix.toarray() @ vectors, atol=1e-13)


@pytest.mark.parametrize("threads", ["1", "2", "3"])
@pytest.mark.parametrize("n_columns", [1, 7])
def test_threads_change_not_a_bit_of_it(threads, n_columns, environment):
    environment(OMP_NUM_THREADS=threads)
    rng = np.random.default_rng(3)
    n = math.ceil(math.sqrt(10 * WORTH_THREADS))
    matrix = sparse.csr_matrix(sparse.random_array((n, n), density=0.101, rng=rng))
    assert matrix.nnz > WORTH_THREADS
    vectors = rng.standard_normal((n, n_columns))
    assert np.array_equal(times(matrix, vectors), matrix @ vectors)
