"""Dense factors that other threads need not wait for: the solutions, whatever the order and shape of what is given."""

from __future__ import annotations

import numpy as np
import pytest

from palpate.mechanics.solvers.cholesky import adjoint_product, backward, forward, lower_factor


@pytest.fixture
def matrix(rng):
    root = rng.standard_normal((7, 7))
    return root @ root.T + np.eye(7)


SHAPES = [(7,), (7, 1), (7, 3), (7, 0)]


@pytest.mark.parametrize("order", ["C", "F"])
@pytest.mark.parametrize("shape", SHAPES)
def test_a_factor_solves_with_itself_and_its_transpose_and_leaves_what_is_given(rng, matrix, shape, order):
    given, rhs = np.array(matrix, order=order), np.array(rng.standard_normal(shape), order=order)
    before, factor = (given.copy(), rhs.copy()), lower_factor(given)
    assert factor == pytest.approx(np.linalg.cholesky(matrix))
    assert factor @ forward(factor, rhs) == pytest.approx(rhs)
    assert factor.T @ backward(factor, rhs) == pytest.approx(rhs)
    assert forward(factor, rhs).shape == backward(factor, rhs).shape == shape
    assert np.array_equal(given, before[0])
    assert np.array_equal(rhs, before[1])


@pytest.mark.parametrize("shape", SHAPES)
def test_a_part_of_a_factor_and_every_other_column_will_do(rng, matrix, shape):
    part = lower_factor(matrix)[:5, :5]
    rhs = rng.standard_normal((10, *(2 * n for n in shape[1:])))[(slice(None, None, 2),) * len(shape)]
    assert part @ forward(part, rhs) == pytest.approx(rhs)
    assert part.T @ backward(part, rhs) == pytest.approx(rhs)
    assert adjoint_product(part, rhs) == pytest.approx(part.T @ rhs)


def test_a_matrix_that_is_not_positive_definite_is_refused_with_the_unknown(matrix):
    matrix[2, 2] = -1.0
    with pytest.raises(np.linalg.LinAlgError, match="leading 3 of 7"):
        lower_factor(matrix)
