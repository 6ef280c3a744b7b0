"""Known loads: pressure (dead, or following the surface as it moves), traction and gravity.

Nodal forces are the virtual work of the load: f_a = int N_a t dA. A pressure p that follows its surface gives
f_a = -p int N_a (x_xi cross x_eta) dxi deta with x = X + u, whose derivative is unsymmetric unless the surface's rim is
held (Bonet & Wood, Nonlinear Continuum Mechanics, 2nd ed. 2008, sections 8.5.2 and 9.5.1).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar, Protocol

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from palpate.errors import ConfigurationError
from palpate.mechanics.element import quadrature, triangle_quadrature, triangle_slopes
from palpate.mesh.space import LagrangeSpace, shape_functions
from palpate.mesh.tet_mesh import OUTER, TetMesh

Array = NDArray[np.float64]

PER_CUBIC_MILLIMETRE = 1e-6  # (kg/m^3)(m/s^2) = N/m^3 = 1e-6 mN/mm^3


class Load(Protocol):
    """External forces as a function of the displacement."""

    @property
    def follows(self) -> bool:
        """Whether the forces change with the displacement."""
        ...

    def forces(self, displacement: Array) -> Array:
        """Nodal forces (n_dof,) mN at u (n_points, 3) mm."""
        ...

    def stiffness(self, displacement: Array) -> sparse.csr_matrix[np.float64]:
        """Derivative of the forces (n_dof, n_dof) mN/mm at u (n_points, 3) mm."""
        ...


@dataclass(frozen=True, slots=True)
class DeadLoad:
    """Nodal forces (n_dof,) mN that stay what they are."""

    follows: ClassVar[bool] = False

    nodal: Array

    def forces(self, displacement: Array) -> Array:
        """Nodal forces (n_dof,) mN, the same at every u (n_points, 3)."""
        del displacement
        return self.nodal

    def stiffness(self, displacement: Array) -> sparse.csr_matrix[np.float64]:
        """Zero (n_dof, n_dof)."""
        return sparse.csr_matrix((displacement.size, displacement.size))


@dataclass(frozen=True, slots=True)
class FollowingPressure:
    """A pressure (kPa) on faces (n_faces, 3 or 6) of `space`, normals out of the body; it pushes along -n."""

    follows: ClassVar[bool] = True  # it turns and grows with its surface

    space: LagrangeSpace
    faces: NDArray[np.int64]
    kilopascal: float

    def forces(self, displacement: Array) -> Array:
        """Nodal forces (n_dof,) mN at u (n_points, 3) mm."""
        shape, slopes, weights = _face_rule(self.space.order)
        along = np.einsum("qad,fai->dfqi", slopes, self._corners(displacement))
        normals = np.cross(along[0], along[1])
        nodal = -self.kilopascal * np.einsum("q,qa,fqi->fai", weights, shape, normals, optimize=True)
        return summed(self.faces, nodal, len(self.space.points))

    def stiffness(self, displacement: Array) -> sparse.csr_matrix[np.float64]:
        """Derivative of the forces (n_dof, n_dof) mN/mm at u (n_points, 3) mm."""
        shape, slopes, weights = _face_rule(self.space.order)
        along = np.einsum("qad,fai->dfqi", slopes, self._corners(displacement))
        # d(x_xi cross x_eta) / dx_bk = N_b,xi (e_k cross x_eta) - N_b,eta (e_k cross x_xi)
        turned = np.cross(np.eye(3), along[:, :, :, None, :])
        change = np.einsum("qb,fqki->fqbki", slopes[..., 0], turned[1]) - np.einsum(
            "qb,fqki->fqbki", slopes[..., 1], turned[0]
        )
        blocks = -self.kilopascal * np.einsum("q,qa,fqbki->faibk", weights, shape, change, optimize=True)
        dofs = (3 * self.faces[:, :, None] + np.arange(3)).reshape(len(self.faces), -1)
        rows = np.broadcast_to(dofs[:, :, None], (*dofs.shape, dofs.shape[1]))
        columns = np.broadcast_to(dofs[:, None, :], rows.shape)
        n = 3 * len(self.space.points)
        return sparse.csr_matrix((blocks.ravel(), (rows.ravel(), columns.ravel())), shape=(n, n))

    def _corners(self, displacement: Array) -> Array:
        """Places (n_faces, 3 or 6, 3) mm of the faces' points."""
        return np.asarray((self.space.points + displacement)[self.faces])


def pressure(
    space: LagrangeSpace, triangles: NDArray[np.int64], kilopascal: float, *, following: bool = True
) -> FollowingPressure | DeadLoad:
    """A pressure (kPa) on boundary triangles (n_faces, 3) whose normals point out of the body; positive pushes inwards.

    following: on the surface as it moves; otherwise the forces of the rest state stay. Raises `ConfigurationError` for
    a pressure that is not a finite number.
    """
    _refuse_infinite("pressure", np.array([kilopascal]))
    load = FollowingPressure(space, space.facets(triangles), float(kilopascal))
    return load if following else DeadLoad(load.forces(np.zeros_like(space.points)))


def traction(space: LagrangeSpace, triangles: NDArray[np.int64], kilopascal: Array) -> DeadLoad:
    """A traction (3,) kPa, force per area of the rest state, on triangles (n_faces, 3); `ConfigurationError`."""
    vector = _refuse_infinite("traction", np.asarray(kilopascal, dtype=float))
    shape, slopes, weights = _face_rule(space.order)
    faces = space.facets(triangles)
    along = np.einsum("qad,fai->dfqi", slopes, space.points[faces])
    areas = np.linalg.norm(np.cross(along[0], along[1]), axis=2)
    nodal = np.einsum("q,qa,fq,i->fai", weights, shape, areas, vector, optimize=True)
    return DeadLoad(summed(faces, nodal, len(space.points)))


def gravity(space: LagrangeSpace, densities: Array, acceleration: Array) -> DeadLoad:
    """Weight of tissues with densities (n_tissues,) kg/m^3, one each of `mesh.tissues`, under (3,) m/s^2 in RAS.

    On a patient who lies on the back gravity is (0, -9.81, 0). Raises `ConfigurationError` for impossible densities.
    """
    vector = _refuse_infinite("acceleration", np.asarray(acceleration, dtype=float))
    mass = _refuse_infinite("density", np.asarray(densities, dtype=float))
    if mass.shape != (len(space.mesh.tissues),) or np.any(mass < 0.0):
        raise ConfigurationError(
            f"densities are {mass.tolist()} kg/m^3; give {len(space.mesh.tissues)} non-negative numbers, one for each"
            f" tissue of {[tissue.name for tissue in space.mesh.tissues]}"
        )
    points, weights = quadrature(2)
    shares = weights @ shape_functions(space.order, points)
    heavy = PER_CUBIC_MILLIMETRE * mass[space.mesh.region] * space.mesh.volumes
    return DeadLoad(summed(space.cells, np.einsum("e,a,i->eai", heavy, shares, vector), len(space.points)))


def boundary_named(mesh: TetMesh, name: str) -> NDArray[np.int64]:
    """Boundary triangles (n_faces, 3) beside the hollow tissue `name`, or on the cut of the image for "outer".

    Their normals point out of the body; a surface that shares faces with another has all of them. Raises
    `ConfigurationError` when there are none, with the names that have some.
    """
    if name in mesh.surfaces:
        return mesh.boundary[mesh.surfaces[name]]
    names = {number: tissue.name for number, tissue in enumerate(mesh.tissues)} | {OUTER: "outer"}
    wanted = [number for number, known in names.items() if known == name]
    faces = mesh.boundary[np.isin(mesh.beyond, wanted)]
    if len(faces) == 0:
        present = sorted({names[int(number)] for number in np.unique(mesh.beyond)})
        raise ConfigurationError(f"no surface of the mesh is called '{name}'; those that can be loaded are {present}")
    return faces


def _face_rule(order: int) -> tuple[Array, Array, Array]:
    """Shape functions (n_q, n_a), their slopes (n_q, n_a, 2) along xi and eta, weights (n_q,) that sum to 1/2."""
    points, weights = triangle_quadrature(2 if order == 1 else 4)
    return shape_functions(order, points), triangle_slopes(order, points), 0.5 * weights


def summed(cells: NDArray[np.int64], nodal: Array, n_points: int) -> Array:
    """Nodal forces (n_dof,), mN, of forces (n_cells, n_a, 3) on the points of cells (n_cells, n_a)."""
    flat = nodal.reshape(-1, 3)
    columns = [np.bincount(cells.ravel(), flat[:, axis], minlength=n_points) for axis in range(3)]
    return np.stack(columns, axis=1).ravel().astype(np.float64)


def _refuse_infinite(what: str, values: Array) -> Array:
    if not np.all(np.isfinite(values)):
        raise ConfigurationError(f"the {what} of a load is {values.tolist()}; give finite numbers")
    return values
