"""The surface of a tissue: its normals and its curvature."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import spatial

from palpate.mesh import vertex_normals


@pytest.mark.parametrize("radius", [0.01, 20.0])
def test_a_balls_normals_are_its_rays_however_it_is_cut_into_triangles(radius):
    rng = np.random.default_rng(3)
    rays = rng.normal(size=(60, 3))
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    corners = spatial.ConvexHull(rays).simplices.astype(np.int64)
    inwards = np.linalg.det(rays[corners]) < 0.0
    triangles = np.where(inwards[:, None], corners[:, ::-1], corners)
    assert vertex_normals(radius * rays, triangles) == pytest.approx(rays, abs=1e-9)


def test_normals_of_what_belongs_to_no_triangle_are_none():
    points = np.vstack([np.eye(3), [[5.0, 5.0, 5.0]]])
    assert vertex_normals(points, np.array([[0, 1, 2]])) == pytest.approx(
        np.vstack([np.ones((3, 3)) / 3**0.5, np.zeros(3)])
    )


def test_a_triangle_without_area_changes_no_normal():
    """As somebody else's mesh may have one: two of its corners are one place."""
    points = np.vstack([np.eye(3), np.eye(3)[:1]])
    assert vertex_normals(points, np.array([[0, 1, 2], [0, 3, 1]])) == pytest.approx(
        np.vstack([np.ones((3, 3)) / 3**0.5, np.zeros(3)])
    )
