"""The six rigid motions of a body, and those that its supports leave free."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.sparse.csgraph import connected_components

from palpate.errors import GeometryError
from palpate.mesh.space import LagrangeSpace

__all__ = ["refuse_floating", "rigid_modes"]

AXES = ("x (right)", "y (anterior)", "z (superior)")
NAMES = tuple(f"translation along {axis}" for axis in AXES) + tuple(f"rotation about {axis}" for axis in AXES)
SUPPORTED = 1e-6  # of the motion, root mean square over the points: below, a motion moves no supported point


def rigid_modes(points: NDArray[np.float64]) -> NDArray[np.float64]:
    """Small rigid motions (3 n_points, 6), mm, of points (n_points, 3) mm: translations, then rotations.

    Translations by 1 mm along x, y, z; rotations u = e x (x - c) / L about the axes through the centroid c, scaled by
    the points' root mean square distance L from it.
    """
    arms = points - points.mean(axis=0)
    scale = float(np.sqrt(np.mean(np.sum(arms**2, axis=1)))) or 1.0
    rotations = [np.cross(axis, arms / scale).ravel() for axis in np.eye(3)]
    translations = [np.tile(axis, len(points)) for axis in np.eye(3)]
    return np.stack(translations + rotations, axis=1)


def refuse_floating(space: LagrangeSpace, free: sparse.csr_matrix[np.float64]) -> None:
    """Raise `GeometryError` when a connected part of the mesh can move rigidly within `free` (n_dof, n_free)."""
    first = np.repeat(space.cells[:, 0], space.cells.shape[1] - 1)
    second = space.cells[:, 1:].ravel()
    n = len(space.points)
    graph = sparse.csr_matrix((np.ones(len(first)), (first, second)), shape=(n, n))
    n_parts, part = connected_components(graph, directed=False)
    for number in range(n_parts):
        points = np.flatnonzero(part == number)
        allowed = free[(3 * points[:, None] + np.arange(3)).ravel()]
        motions = rigid_modes(space.points[points]) / np.sqrt(len(points))
        opposed = motions - allowed @ (allowed.T @ motions)
        values, directions = np.linalg.eigh(opposed.T @ opposed)
        loose = []  # the combinations whose part outside `free` vanishes
        for sizes in np.abs(directions.T[values < SUPPORTED**2]):
            name = NAMES[int(np.argmax(sizes))]
            pure = sizes.max() > 0.99 * float(np.linalg.norm(sizes))
            loose.append(name if pure else f"a motion that is mostly {name}")
        if loose:
            centre = np.round(space.points[points].mean(axis=0), 1).tolist()
            raise GeometryError(
                f"the body floats: a part of {len(points)} points around {centre} mm (RAS) has no support against"
                f" {', '.join(loose)}; hold it with outer_boundary = 'fixed', with a `rigid` or `driver` tissue or a"
                " held surface of its mesh, or remove it from the labels"
            )
