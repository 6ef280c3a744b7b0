"""Points in a mesh: found where they are, and linear and quadratic fields to the last digit there."""

from __future__ import annotations

import numpy as np
import pytest

from palpate.mesh.locate import located, point_interpolation
from palpate.mesh.space import lagrange_space
from palpate_validation.structured_meshes import box_mesh


@pytest.fixture(scope="module")
def mesh():
    return box_mesh(3)


def inside_and_out(mesh, rng):
    low, high = mesh.nodes.min(axis=0), mesh.nodes.max(axis=0)
    points = rng.uniform(low - 0.3 * (high - low), high + 0.3 * (high - low), (500, 3))
    return points, np.all((points >= low) & (points <= high), axis=1)


def test_points_of_a_box_are_found_and_others_are_not(mesh):
    points, inside = inside_and_out(mesh, np.random.default_rng(1))
    places = located(mesh, points)
    assert np.array_equal(places.inside, inside)
    corners = mesh.nodes[mesh.tets[places.tet[inside]]]
    back = np.einsum("nk,nki->ni", places.barycentric[inside], corners)
    np.testing.assert_allclose(back, points[inside], atol=1e-9)


@pytest.mark.parametrize(("element", "power"), [("P1", 1), ("P2", 2)])
def test_polynomials_of_the_elements_order_are_met(mesh, element, power):
    space, rng = lagrange_space(mesh, element), np.random.default_rng(2)
    points, inside = inside_and_out(mesh, rng)
    places = located(mesh, points[inside])
    scaled = (space.points @ rng.standard_normal((3, 2)) + 0.3, points[inside])
    way = rng.standard_normal(3)
    values = (space.points @ way + 0.3) ** power
    expected = (scaled[1] @ way + 0.3) ** power
    np.testing.assert_allclose(point_interpolation(space, places) @ values, expected, rtol=1e-8, atol=1e-9)


@pytest.mark.parametrize(("out", "inside"), [(1e-12, True), (2e-4, True), (2e-3, False)])
def test_a_point_outside_by_rounding_alone_is_inside(mesh, out, inside):
    """By less than a thousandth of an element; what lies further lies outside. A linear field is met there."""
    rng = np.random.default_rng(3)
    low, high = mesh.nodes.min(axis=0), mesh.nodes.max(axis=0)
    points = rng.uniform(low, high, (60, 3))
    axis, end = np.arange(60) % 3, np.arange(60) % 2
    points[np.arange(60), axis] = np.where(end, high[axis] + out, low[axis] - out)  # of cells of a third of a mm
    places = located(mesh, points)
    assert np.all(places.inside == inside)
    space, slope = lagrange_space(mesh, "P1"), rng.standard_normal(3)
    found = point_interpolation(space, places.of(places.inside)) @ (space.points @ slope)
    np.testing.assert_allclose(found, (points @ slope)[places.inside], atol=1e-9)


def test_every_node_lies_in_its_own_mesh(mesh):
    assert located(mesh, mesh.nodes).inside.all()


def test_no_point_is_no_place(mesh):
    assert located(mesh, np.zeros((0, 3))).tet.shape == (0,)
