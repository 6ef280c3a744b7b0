"""Curvature of triangulated surfaces."""

from __future__ import annotations

import numpy as np
import pytest

from palpate.mesh.surface import mean_curvature, triangle_normals
from palpate.phantoms.shapes import rotation_about


def shares(points, triangles):
    """Area (n_nodes,) of each node: a third of its triangles."""
    areas = np.linalg.norm(triangle_normals(points, triangles), axis=1) / 3.0
    return np.bincount(triangles.ravel(), np.repeat(areas, 3), len(points))


@pytest.mark.parametrize("radius", [4.0, 25.0])
def test_a_ball_has_the_curvature_of_its_radius_and_a_cavity_the_opposite_one(sphere, radius):
    vertices, triangles = sphere(3)
    areas = shares(radius * vertices, triangles)
    for faces, sign in ((triangles, 1.0), (triangles[:, ::-1], -1.0)):
        found = np.average(mean_curvature(radius * vertices, faces), weights=areas)
        assert found == pytest.approx(sign / radius, rel=0.01)


def test_a_tube_has_half_the_curvature_of_a_ball():
    turns, rows, radius = 60, 40, 7.0
    angle = 2.0 * np.pi * np.arange(turns) / turns
    ring = np.column_stack([radius * np.cos(angle), radius * np.sin(angle)])
    points = np.column_stack([np.tile(ring, (rows, 1)), np.repeat(0.7 * np.arange(rows), turns)])
    first = turns * np.arange(rows - 1)[:, None] + np.arange(turns)
    beside = turns * np.arange(rows - 1)[:, None] + (np.arange(turns) + 1) % turns
    lower = np.stack([first, beside, first + turns], axis=-1).reshape(-1, 3)
    upper = np.stack([beside, beside + turns, first + turns], axis=-1).reshape(-1, 3)
    inner = slice(turns, -turns)  # the open ends have no curvature
    found = mean_curvature(points, np.concatenate([lower, upper]))[inner]
    assert found == pytest.approx(0.5 / radius, rel=0.01)


def test_curvature_does_not_depend_on_the_frame(sphere, rng):
    vertices, triangles = sphere(2)
    points = vertices * [9.0, 7.0, 12.0] + 0.1 * rng.standard_normal(vertices.shape)
    turned = points @ rotation_about(np.array([1.0, -2.0, 0.5]), 40.0).T + [100.0, -30.0, 7.0]
    assert mean_curvature(turned, triangles) == pytest.approx(mean_curvature(points, triangles), abs=1e-9)
