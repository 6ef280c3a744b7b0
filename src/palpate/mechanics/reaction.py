"""The force that holds a surface of a body: it depends on the moduli directly, and by the displacement near it."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from palpate.errors import SolverError
from palpate.mechanics.dilatation import Dilatation
from palpate.mechanics.finite_strain import FiniteStrainModel, finite_strain_model
from palpate.mechanics.laws.contract import Law
from palpate.mechanics.material import HOMOGENEOUS, MaterialModes
from palpate.mesh.space import Constraint, LagrangeSpace

NEWTON = 1e-3  # of a mN


@dataclass(frozen=True, slots=True)
class SurfaceReaction:
    """F = w^T R(u; E, c), in N, of the internal forces R with a virtual displacement w of the surface's points.

    model: of the elements at the surface alone, without loads; dofs (n,): numbers of their unknowns; virtual (n_dof,),
    dimensionless: the direction of the force on the surface, 0 elsewhere; centre (3,) mm: of the surface.
    """

    model: FiniteStrainModel
    dofs: NDArray[np.int64]
    virtual: NDArray[np.float64]
    centre: NDArray[np.float64]

    def combined(self, fields: NDArray[np.float64]) -> SurfaceReaction:
        """The same by combinations of the fields' coefficients (n_fields, k) of the material."""
        return replace(self, model=replace(self.model, material=self.model.material.combined(fields)))

    def at(
        self, displacement: NDArray[np.float64], moduli: NDArray[np.float64], coefficients: NDArray[np.float64]
    ) -> tuple[float, NDArray[np.float64], NDArray[np.float64]]:
        """F in N, its derivatives by u (n,), N/mm, and by ln E and the material (n_regions + n_material,), N.

        At displacements (n,) mm of `dofs`, moduli (n_regions,) kPa and coefficients (n_material,) of the material.
        Raises `SolverError` where these turn elements inside out under a law of finite strain, which has no force then.
        """
        whole, balance = self._whole(displacement), self.model.balance(moduli, coefficients)
        smallest = balance.smallest_volume(whole)
        if smallest <= 0.0:
            raise SolverError(
                f"the force on the surface around {np.round(self.centre, 1).tolist()} mm (RAS) has no value: the motion"
                f" turns elements there inside out (volume ratio {smallest:.3g}), where the"
                f" {self.model.elements.law.name} law has no stress; check the measurement there and its direction"
            )
        by_region = self.virtual @ balance.region_forces(whole, balance.moduli)
        by_displacement = np.asarray(balance.stiffness(whole).T @ self.virtual)[self.dofs]
        by_material = self.model.material_forces(whole, moduli, coefficients).work(self.virtual)
        return (
            NEWTON * float(by_region.sum()),
            NEWTON * by_displacement,
            NEWTON * np.concatenate([by_region, by_material]),
        )

    def by_poisson(
        self, displacement: NDArray[np.float64], moduli: NDArray[np.float64], coefficients: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """Derivatives (n_regions,) N of F by the regions' Poisson's ratios, at what `at` takes.

        The forces are linear in Lame's constants, whose derivatives take their place.
        """
        changes = self.model.moduli_by_poisson(moduli, coefficients)
        forces = self.model.balance(moduli, coefficients).region_forces(self._whole(displacement), changes)
        return np.asarray(NEWTON * (self.virtual @ forces))

    def _whole(self, displacement: NDArray[np.float64]) -> NDArray[np.float64]:
        """Displacements (n_dof,) mm of all points, of which those of `dofs` (n,) matter."""
        whole = np.zeros(3 * len(self.model.space.points))
        whole[self.dofs] = displacement
        return whole


def surface_reaction(
    space: LagrangeSpace,
    triangles: NDArray[np.int64],
    direction: NDArray[np.float64],
    law: Law,
    *,
    dilatation: Dilatation = Dilatation.BLENDED,
    material: MaterialModes = HOMOGENEOUS,
    strained: NDArray[np.float64] | None = None,
) -> SurfaceReaction:
    """The force on boundary triangles (n_faces, 3) along a direction (3,), positive where it pulls the body that way.

    Under `law`, with the tissues' own Poisson's ratios, in addition to that in the reference where this is `strained`
    (see `finite_strain_model`); raises as that does.
    """
    points = np.unique(space.facets(triangles))
    near = np.flatnonzero(np.isin(space.cells, points).any(axis=1))
    mesh = replace(space.mesh, tets=space.mesh.tets[near], region=space.mesh.region[near])
    beside = replace(space, mesh=mesh, cells=space.cells[near])
    n_dof = 3 * len(space.points)
    held = Constraint(sparse.csr_matrix((n_dof, 0)), np.zeros((n_dof, 0)), np.zeros(n_dof))
    modes = replace(material, fields=sparse.csr_matrix(material.fields[near])) if material.n_modes else material
    model = finite_strain_model(beside, held, law, dilatation=dilatation, material=modes, strained=strained)
    unit = np.asarray(direction, dtype=np.float64) / np.linalg.norm(direction)
    virtual = np.zeros((len(space.points), 3))
    virtual[points] = unit
    dofs = (3 * np.unique(beside.cells)[:, None] + np.arange(3)).ravel()
    return SurfaceReaction(model, dofs, virtual.ravel(), space.points[points].mean(axis=0))
