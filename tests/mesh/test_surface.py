"""The surface of a tissue: its normals and its curvature."""

from __future__ import annotations

import numpy as np
import pytest

from palpate.mesh import vertex_normals


@pytest.mark.parametrize("scale", [1.0, 3.0])
@pytest.mark.parametrize("cut", [0.2, 0.5, 0.8])
def test_how_faces_are_cut_into_triangles_leaves_the_normals(scale, cut):
    """At a cube's corner, one of whose faces is larger than the others, and cut through the corner at an angle."""
    ends = np.array([[scale, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]])
    points = np.concatenate([np.zeros((1, 3)), ends, [cut * ends[0] + (1.0 - cut) * ends[1]]])
    triangles = np.array([[0, 4, 1], [0, 2, 4], [0, 3, 2], [0, 1, 3]])
    assert vertex_normals(points, triangles)[0] == pytest.approx(-np.ones(3) / np.sqrt(3.0))


def test_normals_of_what_belongs_to_no_triangle_are_none():
    points = np.vstack([np.eye(3), [[5.0, 5.0, 5.0]]])
    assert vertex_normals(points, np.array([[0, 1, 2]])) == pytest.approx(
        np.vstack([np.ones((3, 3)) / 3**0.5, np.zeros(3)])
    )
