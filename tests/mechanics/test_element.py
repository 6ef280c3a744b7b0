"""Reference tetrahedra: partition of unity, nodal values, exact integrals."""

from __future__ import annotations

from itertools import product
from math import factorial

import numpy as np
import pytest

from palpate.mechanics.element import (
    barycentric_gradients,
    quadrature,
    reference_tensor,
    shape_derivatives,
)
from palpate.mesh.space import TET_EDGES, shape_functions

ORDERS = (1, 2)


def places(rng, n=7):
    return rng.dirichlet(np.ones(4), size=n)


@pytest.mark.parametrize("order", ORDERS)
def test_shape_functions_sum_to_one(order, rng):
    assert np.allclose(shape_functions(order, places(rng)).sum(axis=1), 1.0, atol=1e-14)


@pytest.mark.parametrize("order", ORDERS)
def test_each_shape_function_is_one_at_its_own_point_and_zero_at_the_others(order):
    corners = np.eye(4)
    points = corners if order == 1 else np.vstack([corners, corners[TET_EDGES].mean(axis=1)])
    assert np.allclose(shape_functions(order, points), np.eye(len(points)), atol=1e-15)


@pytest.mark.parametrize("order", ORDERS)
def test_derivatives_agree_with_differences(order, rng):
    at, step = places(rng), 1e-6
    for axis in range(4):
        shift = step * np.eye(4)[axis]
        difference = (shape_functions(order, at + shift) - shape_functions(order, at - shift)) / (2 * step)
        assert np.allclose(shape_derivatives(order, at)[:, :, axis], difference, atol=1e-9)


@pytest.mark.parametrize("degree", range(7))
def test_quadrature_integrates_every_monomial_up_to_its_degree(degree):
    points, weights = quadrature(degree)
    for powers in product(range(degree + 1), repeat=4):
        if sum(powers) > degree:
            continue
        exact = 6.0 * np.prod([factorial(p) for p in powers]) / factorial(sum(powers) + 3)
        assert np.prod(points ** np.array(powers), axis=1) @ weights == pytest.approx(exact, rel=1e-12)


@pytest.mark.parametrize("order", ORDERS)
def test_reference_tensor_is_the_integral_of_a_finer_rule(order):
    points, weights = quadrature(6)
    derivatives = shape_derivatives(order, points)
    expected = np.einsum("q,qak,qbl->abkl", weights, derivatives, derivatives)
    assert np.allclose(reference_tensor(order), expected, atol=1e-14)


def test_gradients_of_barycentric_coordinates_reproduce_a_linear_field(rng):
    nodes = rng.standard_normal((4, 3))
    gradients, _ = barycentric_gradients(nodes, np.array([[0, 1, 2, 3]]))
    slope = rng.standard_normal(3)
    assert np.allclose((nodes @ slope) @ gradients[0], slope, atol=1e-12)
