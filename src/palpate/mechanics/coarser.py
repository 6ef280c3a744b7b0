"""The linear displacements among the quadratic ones: where multigrid goes first."""

from __future__ import annotations

import numpy as np
from scipy import sparse

from palpate.mechanics.solvers.contract import Coarser
from palpate.mesh.constraint import Constraint
from palpate.mesh.space import LagrangeSpace

__all__ = ["linear_displacements"]


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
