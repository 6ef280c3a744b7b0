"""Fixtures of the observation's tests."""

from __future__ import annotations

import numpy as np
import pytest


@pytest.fixture(scope="session")
def sphere():
    """Vertices and triangles of a subdivided octahedron on the unit sphere, by the number of subdivisions."""
    return geodesic


def geodesic(subdivisions):
    vertices = np.concatenate([np.eye(3), -np.eye(3)])
    triangles = np.array(
        [[0, 1, 2], [1, 3, 2], [3, 4, 2], [4, 0, 2], [1, 0, 5], [3, 1, 5], [4, 3, 5], [0, 4, 5]], dtype=np.int64
    )
    for _ in range(subdivisions):
        edges = np.sort(triangles[:, [[0, 1], [1, 2], [2, 0]]], axis=2)
        pairs, number = np.unique(edges.reshape(-1, 2), axis=0, return_inverse=True)
        middle = vertices[pairs].mean(axis=1)
        ab, bc, ca = (len(vertices) + number.reshape(-1, 3)).T
        a, b, c = triangles.T
        children = [[a, ab, ca], [ab, b, bc], [ca, bc, c], [ab, bc, ca]]
        triangles = np.concatenate([np.stack(child, axis=1) for child in children])
        vertices = np.concatenate([vertices, middle / np.linalg.norm(middle, axis=1, keepdims=True)])
    return vertices, triangles
