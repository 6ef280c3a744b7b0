"""Boundary conditions: what the image's cut holds, what drivers and bones prescribe; with loads, all of one state."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from palpate.errors import ConfigurationError
from palpate.images.tissue import Role
from palpate.mechanics.loads import Load
from palpate.mechanics.rigid import refuse_floating
from palpate.mesh.space import Constraint, LagrangeSpace
from palpate.mesh.surface import cut_faces, triangle_normals

OUTER_KINDS = ("moving", "fixed", "sliding", "free")
SAME_PLANE = 0.07  # of the normals' second moment: faces at less than 30 degrees form one smooth surface


def outer_constraint(
    space: LagrangeSpace,
    *,
    outer: str,
    modes: NDArray[np.float64],
    offset: NDArray[np.float64],
    prescribed: NDArray[np.bool_],
) -> Constraint:
    """Admissible displacements of a body whose `prescribed` (n_points,) points move by modes q + offset.

    modes (n_dof, n_modes) mm and offset (n_dof,) mm must vanish elsewhere. outer holds the points on the cut of the
    image: "moving" (held where nothing else is prescribed, for modes of the frame are prescriptions), "fixed",
    "sliding" (not along the normals of the cut's faces: one on a face, two on an edge, three in a corner) or "free".
    A body glides in any case along what is `sliding`, at each point in the plane of its faces' mean normal.
    The cut faces of `estimate` tissues are free in any case; a point that is also on the cut face of a `known` tissue
    is held; a prescribed point follows its prescription. Raises `GeometryError` when nothing opposes some rigid motion,
    `ConfigurationError` for another `outer` or for arrays that do not fit.
    """
    if outer not in OUTER_KINDS:
        raise ConfigurationError(f"outer_boundary is '{outer}'; it must be one of {list(OUTER_KINDS)}")
    n = len(space.points)
    if modes.ndim != 2 or len(modes) != 3 * n or offset.shape != (3 * n,) or prescribed.shape != (n,):
        raise ConfigurationError(
            f"{n} points need modes ({3 * n}, n_modes), offset ({3 * n},) and prescribed ({n},);"
            f" got {modes.shape}, {offset.shape} and {prescribed.shape}"
        )
    moved = np.any(modes != 0.0, axis=1) | (offset != 0.0)
    stray = moved.reshape(-1, 3).any(axis=1) & ~prescribed
    if stray.any():
        raise ConfigurationError(
            f"modes or offset move {int(stray.sum())} points that are not prescribed (the first is number"
            f" {int(np.flatnonzero(stray)[0])}): mark them in `prescribed` or set their rows to zero"
        )
    cut, behind = cut_faces(space.mesh), [tissue.role is Role.SLIDING for tissue in space.mesh.tissues]
    named = space.mesh.boundary[np.isin(space.mesh.beyond, np.flatnonzero(behind))]
    sliding = np.concatenate([named, cut]) if outer == "sliding" else named
    normals = triangle_normals(space.mesh.nodes, sliding)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    dyads, held = np.einsum("fi,fj->fij", normals, normals), np.zeros((n, 3, 3))
    for column in space.facets(sliding).T:  # the sum of n (x) n over the unit normals n of the faces at each point
        np.add.at(held, column, dyads)
    on_cut = np.zeros(n, dtype=bool)
    on_cut[space.facets(cut).ravel()] = True
    cut_is_held = outer in ("fixed", "moving")
    if cut_is_held:
        held[on_cut] = np.eye(3)
    held[prescribed] = np.eye(3)
    values, vectors = np.linalg.eigh(held)  # point by point free are the directions with no part in `held`
    point, direction = np.nonzero(values <= SAME_PLANE * np.maximum(values[:, -1:], np.finfo(float).tiny))
    columns, rows = np.repeat(np.arange(len(point)), 3), (3 * point[:, None] + np.arange(3)).ravel()
    entries, shape = (vectors[point, :, direction].ravel(), (rows, columns)), (3 * n, len(point))
    free: sparse.csr_matrix[np.float64] = sparse.csr_matrix(entries, shape=shape)
    free.eliminate_zeros()
    refuse_floating(space, free, on_cut & (not cut_is_held))
    return Constraint(free=free, modes=np.array(modes, dtype=float), offset=np.array(offset, dtype=float))


@dataclass(frozen=True, slots=True)
class Conditions:
    """Admissible displacements of one state, and the loads that act in it.

    Models of several states of a body differ in nothing else, and share what it costs to make them.
    """

    constraint: Constraint
    loads: tuple[Load, ...] = ()

    def forces(self, space: LagrangeSpace) -> NDArray[np.float64]:
        """Nodal forces (n_dof,) mN of all loads on the body at rest."""
        still = np.zeros_like(space.points)
        return sum((load.forces(still) for load in self.loads), np.zeros(still.size))

    def require_space(self, space: LagrangeSpace) -> None:
        """Raise `ConfigurationError` unless the constraint is of the space."""
        given, n_dof = self.constraint, 3 * len(space.points)
        if given.free.shape[0] != n_dof or len(given.modes) != n_dof or len(given.offset) != n_dof:
            raise ConfigurationError(
                f"the constraint has {given.free.shape[0]} unknowns and the space {n_dof}: make both of the same space"
            )

    def require_same_free(self, other: Constraint) -> None:
        """Raise `ConfigurationError` unless the same displacements are free as under another constraint."""
        free, theirs = self.constraint.free, other.free
        if free is not theirs and (free.shape != theirs.shape or abs(free - theirs).max() > 0.0):
            raise ConfigurationError(
                f"the conditions free other displacements ({free.shape[1]}) than the model ({theirs.shape[1]}): make a"
                " model of its own for them, with `linear_model` or `finite_strain_model`"
            )
