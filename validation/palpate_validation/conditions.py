"""What is prescribed to the bodies of the problems, and how they are solved and read."""

from __future__ import annotations

from typing import TypedDict

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import sparse

from palpate.mechanics import (
    Dilatation,
    barycentric_gradients,
    factorise,
    linear_model,
    outer_constraint,
    shape_derivatives,
    weighted_sum,
)
from palpate.mesh import FACES, Constraint, LagrangeSpace, TetMesh, triangle_normals

__all__ = [
    "Prescription",
    "all_prescribed",
    "held_components",
    "loaded",
    "mean_radial",
    "nodal_gradients",
    "prescribe",
    "pressure_load",
    "sliding_sides",
    "sphere_faces",
]

Array = NDArray[np.float64]
Integers = NDArray[np.int64]


class Prescription(TypedDict):
    """Keywords for `outer_constraint`."""

    prescribed: NDArray[np.bool_]
    offset: Array
    modes: Array


def prescribe(space: LagrangeSpace, points: Integers, displacement: Array, modes: Array | None = None) -> Prescription:
    """`points` (n,) move by `displacement` (n, 3) mm plus modes (n, 3, n_modes) mm."""
    prescribed = np.zeros(len(space.points), bool)
    prescribed[points] = True
    offset = np.zeros((len(space.points), 3))
    offset[points] = displacement
    n_modes = 0 if modes is None else modes.shape[2]
    columns = np.zeros((len(space.points), 3, n_modes))
    if modes is not None:
        columns[points] = modes
    return {"prescribed": prescribed, "offset": offset.ravel(), "modes": columns.reshape(3 * len(columns), n_modes)}


def all_prescribed(space: LagrangeSpace, displacement: Array) -> Prescription:
    """The points on the mesh's boundary move as `displacement` (n_points, 3) mm says of them."""
    points = np.unique(space.facets(space.mesh.boundary))
    return prescribe(space, points, displacement[points])


def sliding_sides(space: LagrangeSpace) -> Constraint:
    """The outer sides of the mesh slide, nothing else is held."""
    return outer_constraint(space, outer="sliding", **prescribe(space, np.zeros(0, int), np.zeros((0, 3))))


def held_components(held: NDArray[np.bool_], values: Array, modes: Array | None = None) -> Constraint:
    """Components (n_points, 3) marked in `held` are at values (n_points, 3) mm plus a mode (n_points, 3) mm or more."""
    free_dofs = np.flatnonzero(~held.ravel())
    n = held.size
    entries = (np.ones(len(free_dofs)), (free_dofs, np.arange(len(free_dofs))))
    free = sparse.csr_matrix(entries, shape=(n, len(free_dofs)))
    columns = np.zeros((n, 0)) if modes is None else modes.reshape(n, -1) * held.reshape(n, 1)
    return Constraint(free=free, modes=columns, offset=np.where(held, values, 0.0).ravel())


def loaded(
    space: LagrangeSpace,
    constraint: Constraint,
    load: Array,
    *,
    moduli: ArrayLike,
    dilatation: Dilatation = Dilatation.POINTWISE,
) -> Array:
    """Displacement (n_dof,) mm under the linear law, offset of the constraint and nodal forces load (n_dof,) mN.

    moduli (n_regions,) kPa.
    """
    model = linear_model(space, constraint, dilatation=dilatation)
    values, free, offset = np.asarray(moduli, dtype=float), constraint.free, constraint.offset
    pull = load - model.forces(values, offset[:, None])[:, 0]
    matrix = weighted_sum(values, model.free_stiffness)
    found = factorise(matrix).solve(np.asarray(free.T @ pull)[:, None])
    return np.asarray(free @ found)[:, 0] + offset


def pressure_load(space: LagrangeSpace, triangles: Integers, pressure: float) -> Array:
    """Nodal forces (n_dof,) mN of a pressure (kPa) on plane faces (n_faces, 3) whose normals point out of the body."""
    normals = triangle_normals(space.mesh.nodes, triangles)
    share = np.full(3, 1 / 3) if space.order == 1 else np.array([0, 0, 0, 1, 1, 1]) / 3  # mean of the shape functions
    forces = np.zeros((len(space.points), 3))
    for column, weight in zip(space.facets(triangles).T, share, strict=True):
        np.add.at(forces, column, -pressure * weight * normals)
    return np.asarray(forces.ravel())


def sphere_faces(mesh: TetMesh, radius: float) -> Integers:
    """Faces (n, 3) of the mesh on a sphere of `radius` mm around the origin, normals pointing outwards."""
    distance = np.linalg.norm(mesh.nodes, axis=1)
    faces = np.unique(np.sort(mesh.tets[:, FACES].reshape(-1, 3), axis=1), axis=0)
    faces = faces[np.all(np.abs(distance[faces] / radius - 1.0) < 0.02, axis=1)]
    inwards = np.einsum("ij,ij->i", triangle_normals(mesh.nodes, faces), mesh.nodes[faces[:, 0]]) < 0.0
    faces[inwards] = faces[inwards][:, ::-1]
    return np.asarray(faces)


def mean_radial(space: LagrangeSpace, radius: float) -> Array:
    """Row (n_dof,): the volume that an eighth of a sphere (mm) sweeps over its exact area, its mean radial motion."""
    return pressure_load(space, sphere_faces(space.mesh, radius), -1.0) / (0.5 * np.pi * radius**2)


def nodal_gradients(space: LagrangeSpace, displacement: Array, nodes: Integers) -> Array:
    """Gradient (n, 3, 3) of a displacement (n_points, 3) mm at `nodes` (n,): the mean over the cells at each."""
    by_lambda = shape_derivatives(space.order, np.eye(4))
    gradients, _ = barycentric_gradients(space.mesh.nodes, space.mesh.tets)
    slopes = np.einsum("qak,ekj,eai->eqij", by_lambda, gradients, displacement[space.cells], optimize=True)
    total = np.zeros((len(space.mesh.nodes), 3, 3))
    count = np.zeros(len(space.mesh.nodes))
    np.add.at(total, space.mesh.tets, slopes)
    np.add.at(count, space.mesh.tets, 1.0)
    return np.asarray(total[nodes] / count[nodes, None, None])
