"""A product with a few vectors is the product, in whatever order the columns are taken."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import sparse

from palpate.mechanics.solvers.products import FEW, times


@pytest.mark.parametrize("n_columns", [0, 1, 3, FEW - 1, FEW, FEW + 5])
@pytest.mark.parametrize("order", ["C", "F"])
def test_it_is_that_of_the_dense_matrix(n_columns, order):
    rng = np.random.default_rng(2)
    matrix = sparse.csr_matrix(sparse.random_array((30, 20), density=0.3, rng=rng))
    vectors = np.asarray(rng.standard_normal((20, n_columns)), order=order)
    found = times(matrix, vectors)
    assert found.shape == (30, n_columns)
    assert np.allclose(found, matrix.toarray() @ vectors, atol=1e-13)
