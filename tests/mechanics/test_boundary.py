"""Boundary conditions: how many directions stay free where, and what is refused."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from palpate.errors import ConfigurationError, GeometryError
from palpate.images.tissue import Role, Tissue
from palpate.mechanics.boundary import outer_constraint
from palpate.mesh.space import lagrange_space
from palpate.mesh.tet_mesh import TetMesh

N = 3


def free_directions(constraint):
    """Number (n_points,) of free directions of each point."""
    used = np.diff(constraint.free.tocsc().indptr)
    assert np.all(used > 0)
    squared = constraint.free.multiply(constraint.free).sum(axis=1)
    return np.round(np.asarray(squared).reshape(-1, 3).sum(axis=1)).astype(int)


def sides(points, size=1.0):
    """On how many of the box's sides each point lies."""
    return np.sum((np.abs(points) < 1e-9) | (np.abs(points - size) < 1e-9), axis=1)


@pytest.fixture
def space(meshes):
    return lagrange_space(meshes.box_mesh(N), "P2")


def nothing(meshes, space):
    return meshes.prescribe(space, np.zeros(0, int), np.zeros((0, 3)))


def test_fixed_holds_every_point_of_the_cut(meshes, space):
    free = free_directions(outer_constraint(space, outer="fixed", **nothing(meshes, space)))
    assert np.array_equal(free, np.where(sides(space.points) > 0, 0, 3))


def test_sliding_holds_one_normal_on_a_face_two_on_an_edge_three_in_a_corner(meshes, space):
    free = free_directions(outer_constraint(space, outer="sliding", **nothing(meshes, space)))
    assert np.array_equal(free, 3 - sides(space.points))


def test_sliding_on_a_turned_box_holds_its_own_normals(meshes, space, rng):
    turn, _ = np.linalg.qr(rng.standard_normal((3, 3)))
    turn *= np.linalg.det(turn)
    mesh = space.mesh
    turned = TetMesh(mesh.nodes @ turn.T, mesh.tets, mesh.region, mesh.boundary, mesh.beyond, mesh.tissues)
    constraint = outer_constraint(lagrange_space(turned, "P2"), outer="sliding", **nothing(meshes, space))
    assert np.array_equal(free_directions(constraint), 3 - sides(space.points))
    on_one = np.flatnonzero((np.abs(space.points[:, 0]) < 1e-9) & (sides(space.points) == 1))
    rows = constraint.free.toarray().reshape(-1, 3, constraint.free.shape[1])[on_one]
    assert np.allclose(np.einsum("pic,i->pc", rows, turn[:, 0]), 0.0, atol=1e-12)


@pytest.mark.parametrize("outer", ["fixed", "sliding"])
def test_free_columns_are_orthonormal(meshes, space, outer):
    free = outer_constraint(space, outer=outer, **nothing(meshes, space)).free
    assert abs(free.T @ free - np.eye(free.shape[1])).max() < 1e-12


def test_free_leaves_all_but_the_prescribed_points_free(meshes, space):
    bottom = np.flatnonzero(space.points[:, 2] < 1e-9)
    given = meshes.prescribe(space, bottom, np.ones((len(bottom), 3)))
    free = free_directions(outer_constraint(space, outer="free", **given))
    assert np.array_equal(free, np.where(space.points[:, 2] < 1e-9, 0, 3))


def test_prescription_wins_over_the_fixed_cut(meshes, space):
    corner = np.flatnonzero(sides(space.points) == 3)
    given = meshes.prescribe(space, corner, np.ones((len(corner), 3)))
    constraint = outer_constraint(space, outer="fixed", **given)
    assert np.all(constraint.offset.reshape(-1, 3)[corner] == 1.0)
    assert np.all(free_directions(constraint)[corner] == 0)


def two_halves(meshes):
    return meshes.box_mesh(
        4, tissues=[meshes.known("fat"), meshes.unknown("organ")], region=lambda c: (c[:, 0] > 0.5).astype(int)
    )


@pytest.mark.parametrize("outer", ["fixed", "sliding"])
def test_the_cut_of_an_estimated_tissue_is_free_but_where_it_meets_a_known_one(meshes, outer):
    space = lagrange_space(two_halves(meshes), "P2")
    free = free_directions(outer_constraint(space, outer=outer, **nothing(meshes, space)))
    beyond = space.points[:, 0] > 0.5 + 1e-9
    assert np.all(free[beyond] == 3)
    assert np.all(free[(~beyond) & (sides(space.points) > 0)] < 3)


def test_a_void_leaves_its_surface_free(meshes):
    mesh = meshes.box_mesh(
        N, tissues=[meshes.known("fat"), meshes.VOID], beyond=lambda c: np.where(c[:, 2] > 1 - 1e-9, 1, -1)
    )
    space = lagrange_space(mesh, "P1")
    free = free_directions(outer_constraint(space, outer="fixed", **nothing(meshes, space)))
    inside = np.all((space.points[:, :2] > 1e-9) & (space.points[:, :2] < 1 - 1e-9), axis=1)
    assert np.all(free[inside & (space.points[:, 2] > 1 - 1e-9)] == 3)


def test_a_floating_body_is_refused_with_its_six_motions(meshes, space):
    with pytest.raises(GeometryError) as caught:
        outer_constraint(space, outer="free", **nothing(meshes, space))
    assert all(word in str(caught.value) for word in ("translation", "rotation", "x (right)", "z (superior)"))


def test_a_body_that_can_only_turn_is_refused_for_its_rotation(meshes, space):
    axis = np.flatnonzero((space.points[:, 0] < 1e-9) & (space.points[:, 1] < 1e-9))
    given = meshes.prescribe(space, axis, np.zeros((len(axis), 3)))
    with pytest.raises(GeometryError, match="mostly"):
        outer_constraint(space, outer="free", **given)


def test_a_sliding_plane_alone_is_no_support_along_it(meshes):
    mesh = meshes.box_mesh(
        N, tissues=[meshes.known("fat"), meshes.VOID], beyond=lambda c: np.where(c[:, 2] < 1e-9, -1, 1)
    )
    space = lagrange_space(mesh, "P2")
    with pytest.raises(GeometryError) as caught:
        outer_constraint(space, outer="sliding", **nothing(meshes, space))
    assert "z (superior)" in str(caught.value)  # it may turn about the normal
    assert "translation along z" not in str(caught.value)  # but not leave the plane


def test_a_body_glides_along_a_curved_surface_in_its_tangent_planes(meshes):
    """A roof whose facets lie at 8 degrees to each other is one surface, and its edges with the walls are edges."""
    roof = Tissue("rail", Role.SLIDING)
    mesh = meshes.box_mesh(
        4, tissues=[meshes.known("fat"), meshes.VOID, roof], beyond=lambda c: np.where(c[:, 2] > 1 - 1e-9, 2, -1)
    )
    nodes = mesh.nodes.copy()
    nodes[:, 2] *= 1.0 - 0.3 * (nodes[:, 0] - 0.5) ** 2
    space = lagrange_space(replace(mesh, nodes=nodes), "P1")
    constraint = outer_constraint(space, outer="fixed", **nothing(meshes, space))
    on_roof = np.unique(mesh.boundary[mesh.beyond == 2])
    inside = on_roof[np.all((nodes[on_roof, :2] > 1e-9) & (nodes[on_roof, :2] < 1 - 1e-9), axis=1)]
    assert set(free_directions(constraint)[inside]) == {2}
    rows = constraint.free.toarray().reshape(-1, 3, constraint.free.shape[1])[inside]
    slope = 0.6 * (nodes[inside, 0] - 0.5)
    normals = np.stack([slope, np.zeros_like(slope), np.ones_like(slope)], axis=1)
    assert np.abs(np.einsum("pic,pi->pc", rows, normals)).max() < 0.03


def test_an_island_without_support_is_refused_even_when_the_rest_is_held(meshes):
    mesh = meshes.box_mesh(1)
    island = 0.2 * mesh.nodes + 5.0
    both = meshes.make_mesh(
        np.vstack([mesh.nodes, island]),
        np.vstack([mesh.tets, mesh.tets + len(mesh.nodes)]),
        np.repeat([0, 1], len(mesh.tets)),
        [meshes.known("fat"), meshes.unknown("island")],
    )
    space = lagrange_space(both, "P1")
    with pytest.raises(GeometryError, match=r"a part of 8 points around \[5\.1, 5\.1, 5\.1\] mm"):
        outer_constraint(space, outer="fixed", **nothing(meshes, space))


def test_motion_of_points_that_are_not_prescribed_is_refused(meshes, space):
    given = nothing(meshes, space)
    given["offset"][4] = 1.0
    with pytest.raises(ConfigurationError, match="not prescribed"):
        outer_constraint(space, outer="fixed", **given)


def test_arrays_of_another_size_are_refused(meshes, space):
    given = nothing(meshes, space) | {"offset": np.zeros(5)}
    with pytest.raises(ConfigurationError, match=r"got .*\(5,\)"):
        outer_constraint(space, outer="fixed", **given)


def test_an_unknown_outer_boundary_is_refused_with_the_known_ones(meshes, space):
    with pytest.raises(ConfigurationError, match=r"fixed.*sliding.*free"):
        outer_constraint(space, outer="glued", **nothing(meshes, space))
