"""Displacements of little energy: the six rigid motions, those that supports leave free, the linear ones."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.sparse.csgraph import connected_components

from palpate.errors import GeometryError
from palpate.mechanics.solvers.contract import Coarser
from palpate.mesh.space import Constraint, LagrangeSpace

AXES = ("x (right)", "y (anterior)", "z (superior)")
NAMES = tuple(f"translation along {axis}" for axis in AXES) + tuple(f"rotation about {axis}" for axis in AXES)
SUPPORTED = 1e-6  # of the motion (root mean square), below which a motion counts as moving no supported point


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


def refuse_floating(space: LagrangeSpace, free: sparse.csr_matrix[np.float64], holdable: NDArray[np.bool_]) -> None:
    """Raise `GeometryError` when a connected part of the mesh can move rigidly within `free` (n_dof, n_free).

    holdable (n_points,): on the image's cut, where another `outer_boundary` would hold them.
    """
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
            by_cut = "outer_boundary = 'fixed', with " if holdable[points].any() else ""
            raise GeometryError(
                f"the body floats: a part of {len(points)} points around {centre} mm (RAS) has no support against"
                f" {', '.join(loose)}; hold it with {by_cut}a `rigid` or `driver` tissue or a held surface of its mesh,"
                " or remove it from the labels"
            )


def linear_displacements(space: LagrangeSpace, constraint: Constraint) -> Coarser | None:
    """The free displacements (n_coarse,) of the corners, and all the free ones (n_free,) that they make.

    A quadratic function that is linear has at the middle of an edge the mean of its ends. None for linear elements, and
    where no corner is free.
    """
    if space.order == 1:
        return None
    n, n_edges = len(space.mesh.nodes), len(space.edges)
    half = sparse.csr_matrix(
        (np.full(2 * n_edges, 0.5), space.edges.ravel(), 2 * np.arange(n_edges + 1)), shape=(n_edges, n)
    )
    spread = sparse.kron(sparse.vstack([sparse.eye_array(n), half]), sparse.eye_array(3), format="csr")
    free = constraint.free
    kept = np.unique(free[: 3 * n].indices)  # each belongs to one point
    if not len(kept):
        return None
    corners = free[: 3 * n][:, kept]
    prolongation = sparse.csr_matrix(free.T @ sparse.csr_matrix(spread @ corners))
    return Coarser(prolongation, kept.astype(np.int64))
