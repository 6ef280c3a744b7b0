"""The Jacobian of residuals that is never formed: all that is asked of it, against the one that is."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import sparse

from palpate.observation.jacobian import ROWS, Jacobian, jacobian_of


@pytest.fixture
def whole(rng):
    """S (50, 12), T (12, 7), and J with two offsets of which the residuals have the second."""
    smooth = sparse.random_array((50, 12), density=0.3, rng=rng, format="csr")
    tangent = rng.standard_normal((12, 7))
    dense = np.column_stack([smooth @ tangent, np.zeros(50), np.ones(50)])
    return jacobian_of(smooth, tangent, number=1, n_offsets=2), dense


def test_it_is_the_product_of_its_factors(whole, rng):
    jacobian, dense = whole
    weights, x, y = rng.random(50), rng.standard_normal(9), rng.standard_normal((50, 3))
    sums = sparse.random_array((4, 50), density=0.5, rng=rng, format="csr")
    assert jacobian.shape == dense.shape
    assert jacobian.dense == pytest.approx(dense)
    assert jacobian.times(x) == pytest.approx(dense @ x)
    assert jacobian.transposed_times(y) == pytest.approx(dense.T @ y)
    assert jacobian.gram(weights) == pytest.approx(dense.T @ (weights[:, None] * dense))
    change = np.where(np.arange(50) % 9 == 0, rng.standard_normal(50), 0.0)
    assert jacobian.changed_gram(jacobian.gram(weights), change) == pytest.approx(
        dense.T @ ((weights + change)[:, None] * dense)
    )
    assert jacobian.summed(sums) == pytest.approx(sums @ dense)
    some = np.array([0, 3, 8])
    assert jacobian.of_columns(some).dense == pytest.approx(dense[:, some])
    assert jacobian.of_rows(slice(5, 20)).dense == pytest.approx(dense[5:20])


def test_other_derivatives_of_the_displacement_leave_those_by_offsets(whole, rng):
    jacobian, dense = whole
    tangent = rng.standard_normal((12, 7))
    other = jacobian.with_tangent(tangent).dense
    assert other[:, 7:] == pytest.approx(dense[:, 7:])
    assert other[:, :7] == pytest.approx(jacobian.by_displacement[:, :-1] @ tangent)


def test_one_that_is_formed_is_itself(rng):
    dense = rng.standard_normal((6, 3))
    assert Jacobian.of(dense).dense == pytest.approx(dense)


def test_it_is_the_same_product_with_more_residuals_than_are_formed_at_once(rng):
    """As a field of measured points has it: about as many residuals as displacements."""
    rows, dofs, columns = ROWS + 103, ROWS, 7
    seen = sparse.random_array((rows, dofs), density=1e-3, rng=rng, format="csr")
    jacobian = Jacobian(sparse.csr_matrix(seen), rng.standard_normal((dofs, columns)))
    weights = rng.uniform(0.0, 2.0, rows)
    assert jacobian.gram(weights) == pytest.approx(jacobian.dense.T @ (weights[:, None] * jacobian.dense), rel=1e-9)
