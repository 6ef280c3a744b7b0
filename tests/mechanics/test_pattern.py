"""Element blocks find their places, and the free part of a matrix is cut out exactly."""

from __future__ import annotations

import numpy as np
import pytest

from palpate.mechanics.boundary import outer_constraint
from palpate.mechanics.pattern import block_pattern, restriction
from palpate.mesh.space import lagrange_space
from palpate.mesh.tet_mesh import TetMesh


def test_blocks_are_summed_at_the_places_of_their_points(rng):
    cells = np.array([[0, 2, 3], [3, 1, 0]])
    blocks = rng.standard_normal((2, 3, 3, 3, 3))
    expected = np.zeros((4, 3, 4, 3))
    for cell, block in zip(cells, blocks, strict=True):
        for a in range(3):
            for b in range(3):
                expected[cell[a], :, cell[b], :] += block[a, b]
    found = block_pattern(cells, 4).assemble(blocks.reshape(-1, 9))
    assert np.allclose(found.toarray(), expected.reshape(12, 12))


@pytest.mark.parametrize("turned", [False, True])
def test_the_free_part_is_the_product_with_the_free_directions(meshes, rng, turned):
    mesh = meshes.box_mesh(2, size=10.0)
    if turned:  # sliding on slanted planes: the free directions are no longer unknowns
        turn, _ = np.linalg.qr(rng.standard_normal((3, 3)))
        turn *= np.linalg.det(turn)
        mesh = TetMesh(mesh.nodes @ turn.T, mesh.tets, mesh.region, mesh.boundary, mesh.beyond, mesh.tissues)
    space = lagrange_space(mesh, "P2")
    nothing = meshes.prescribe(space, np.zeros(0, int), np.zeros((0, 3)))
    constraint = outer_constraint(space, outer="sliding", **nothing)
    pattern = block_pattern(space.cells, len(space.points))
    matrix = pattern.assemble(rng.standard_normal((space.cells.size * 10, 9)))
    cut = restriction(constraint, matrix)
    assert (cut.places is None) == turned
    expected = constraint.free.T @ matrix @ constraint.free
    assert abs(cut.of(matrix) - expected).max() < 1e-12
