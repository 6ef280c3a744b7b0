"""Dihedral angles: the measure of a tetrahedron's quality that finite elements feel."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from palpate.mesh.tet_mesh import FACES

__all__ = ["tet_dihedrals"]

FACE_PAIRS = np.array([[0, 1], [0, 2], [0, 3], [1, 2], [1, 3], [2, 3]])


def tet_dihedrals(corners: NDArray[np.float64]) -> NDArray[np.float64]:
    """Angles (n, 6) in degrees between the faces of tetrahedra with `corners` (n, 4, 3) mm, at their six edges.

    180 degrees less the angle between outward normals; the same for an inverted tetrahedron.
    """
    a, b, c = (corners[:, FACES[:, i]] for i in range(3))
    normals = np.cross(b - a, c - a)
    normals /= np.maximum(np.linalg.norm(normals, axis=2, keepdims=True), 1e-300)
    cosine = np.einsum("npi,npi->np", normals[:, FACE_PAIRS[:, 0]], normals[:, FACE_PAIRS[:, 1]])
    return np.asarray(180.0 - np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0))))
