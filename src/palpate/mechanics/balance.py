"""The forces on several tissues, and their tangent stiffness, summed over the elements."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from palpate.mechanics.hyperelastic import Elements, Moduli
from palpate.mechanics.linearised import LinearisedSystem, symmetric_part
from palpate.mechanics.loads import Load, summed
from palpate.mechanics.pattern import BlockPattern, Restriction, Stiffness, restricted
from palpate.mechanics.rigid import rigid_modes
from palpate.mechanics.solvers.contract import Factorisation
from palpate.mechanics.solvers.registry import factorise
from palpate.mesh.space import LagrangeSpace

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class TissueBalance:
    """Internal and external forces with Lame's constants `moduli`, as functions of the displacement.

    element_region (n_tets,): number of each tetrahedron's tissue among the n_regions meshed ones; free (n_dof, n_free).
    """

    space: LagrangeSpace
    elements: Elements
    element_region: NDArray[np.int64]
    n_regions: int
    loads: tuple[Load, ...]
    pattern: BlockPattern
    restriction: Restriction
    solver: str
    moduli: Moduli

    @property
    def free(self) -> sparse.csr_matrix[np.float64]:
        """Orthonormal columns F (n_dof, n_free) of the free displacements."""
        return self.restriction.free

    def residual(self, displacement: Array) -> tuple[Array, float]:
        """Internal less external forces R (n_dof,) mN, and the length of the internal ones, at u (n_dof,) mm."""
        nodal = displacement.reshape(-1, 3)
        internal = self._sum(self.elements.forces(nodal, self.moduli))
        external = np.zeros_like(internal)
        for load in self.loads:
            external += load.forces(nodal)
        return internal - external, float(np.linalg.norm(internal))

    def region_forces(self, displacement: Array, moduli: Moduli) -> Array:
        """Internal forces (n_dof, n_regions), mN, of each tissue at u (n_dof,) mm, with other Lame constants."""
        forces = self.elements.forces(displacement.reshape(-1, 3), moduli)
        regions = range(self.n_regions)
        return np.stack([self._sum(forces, self.element_region == r) for r in regions], axis=1)

    def stiffness(self, displacement: Array, pressure: Array | None = None) -> Stiffness:
        """K = dR/du (n_dof, n_dof) mN/mm at u (n_dof,) mm; loads that follow the body make it unsymmetric.

        pressure (n_cells,) kPa takes the place of the mean pressures at u.
        """
        nodal = displacement.reshape(-1, 3)
        matrix: Stiffness = self.pattern.assemble(self.elements.stiffness(nodal, self.moduli, pressure=pressure))
        followers = [load.stiffness(nodal) for load in self.loads if load.follows]
        for follower in followers:
            matrix = sparse.csr_matrix(matrix - follower)
        return matrix

    @property
    def symmetric(self) -> bool:
        """Whether no load follows the body."""
        return not any(load.follows for load in self.loads)

    def pressure_ahead(self, displacement: Array, change: Array) -> Array:
        """Mean pressures (n_cells,) kPa at u + du by linear extrapolation from u (n_dof,) along du (n_dof,) mm."""
        return self.elements.pressure_ahead(displacement.reshape(-1, 3), change.reshape(-1, 3), self.moduli)

    def restricted(self, stiffness: Stiffness) -> sparse.csr_matrix[np.float64]:
        """F^T K F (n_free, n_free), mN/mm, of a stiffness K (n_dof, n_dof)."""
        if isinstance(stiffness, sparse.bsr_matrix):  # no load follows the body
            return self.restriction.of(stiffness)
        return restricted(sparse.csr_matrix(stiffness), self.free)

    def factorise(self, stiffness: Stiffness) -> Factorisation:
        """Factorisation of F^T K F (n_free, n_free), of its symmetric part where loads follow; `SolverError`."""
        restricted = self.restricted(stiffness)
        symmetric = restricted if self.symmetric else symmetric_part(restricted)
        near_nullspace = np.asarray(self.free.T @ rigid_modes(self.space.points))
        inner = factorise(symmetric, solver=self.solver, near_nullspace=near_nullspace)
        return inner if self.symmetric else LinearisedSystem(restricted, inner, symmetric=False)

    def smallest_volume(self, displacement: Array) -> float:
        """Smallest J at a quadrature point at u (n_dof,) mm; infinity for the small-strain law."""
        if not self.elements.law.finite:
            return np.inf if np.all(np.isfinite(displacement)) else -np.inf
        return self.elements.smallest_volume(displacement.reshape(-1, 3))[0]

    def weakest(self, displacement: Array) -> str:
        """Words for the element with the smallest J at u (n_dof,) mm."""
        volume, element = self.elements.smallest_volume(displacement.reshape(-1, 3))
        mesh = self.space.mesh
        centre = np.round(mesh.nodes[mesh.tets[element]].mean(axis=0), 1).tolist()
        name = mesh.tissues[int(mesh.region[element])].name
        return f"tetrahedron {element} of '{name}' at {centre} mm (RAS; volume ratio {volume:.3g})"

    def _sum(self, forces: Array, part: NDArray[np.bool_] | None = None) -> Array:
        """Nodal forces (n_dof,) of element forces (n_cells, n_a, 3), of all or of a part of the elements."""
        cells = self.elements.cells if part is None else self.elements.cells[part]
        return summed(cells, forces if part is None else forces[part], len(self.space.points))
