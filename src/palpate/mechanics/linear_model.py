"""Small-strain equilibrium of several tissues: affine in the moduli, linear in the boundary modes.

K(E) = sum_r E_r K_r, one r for each tissue; an admissible u = F z + M q + o is in equilibrium when F^T (K u - f) = 0,
that is K_ff z = F^T f - F^T K (M q + o) with K_ff = F^T K F and dead loads f.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from palpate.mechanics.boundary import Conditions
from palpate.mechanics.dilatation import Dilatation
from palpate.mechanics.forward import DenseEquilibrium, SolveCounts, checked_coefficients, checked_moduli
from palpate.mechanics.hyperelastic import Elements, Moduli, elements_of
from palpate.mechanics.laws.linear import Linear
from palpate.mechanics.loads import Load
from palpate.mechanics.material import (
    HOMOGENEOUS,
    MaterialForces,
    MaterialModes,
    material_force_along,
    material_forces,
)
from palpate.mechanics.pattern import restricted
from palpate.mechanics.rigid import linear_displacements, rigid_modes
from palpate.mechanics.solvers.conjugate_gradients import times
from palpate.mechanics.solvers.contract import EXACT, Factorisation, together
from palpate.mechanics.solvers.registry import factorise
from palpate.mechanics.stiffness import (
    lame_parts,
    lame_parts_by_poisson,
    stiffness_by_poisson,
    tissue_stiffness,
)
from palpate.mesh.space import Constraint, LagrangeSpace
from palpate.parallel import mapped

LINEAR = Linear()
OF_ERROR = 1e-4  # relative residual of the solution from which an error is computed
FURTHER = 10  # right-hand sides for each modulus beside those of the modes: sensitivities, series


@dataclass(frozen=True, slots=True)
class LinearModel:
    """Assembled stiffness of every meshed tissue under the conditions of one state.

    regions: indices in `space.mesh.tissues` of the meshed ones; per region at 1 kPa: stiffness K_r (n_dof, n_dof),
    free_stiffness F^T K_r F (n_free, n_free), coupling F^T K_r [M, o] (n_free, n_modes + 1), all mN/mm.
    material: how the tissues may differ from homogeneous ones,
    to first order in its coefficients: u(E, q, c) = u(E, q) + sum_k c_k du/dc_k, coefficients being those of the
    boundary modes, then c.
    """

    space: LagrangeSpace
    conditions: Conditions
    regions: tuple[int, ...]
    stiffness: tuple[sparse.csr_matrix[np.float64], ...]
    free_stiffness: tuple[sparse.csr_matrix[np.float64], ...]
    coupling: tuple[sparse.csr_matrix[np.float64], ...]
    solver: str
    elements: Elements | None = None
    material: MaterialModes = HOMOGENEOUS

    @property
    def constraint(self) -> Constraint:
        """What is prescribed."""
        return self.conditions.constraint

    def with_conditions(self, conditions: Conditions) -> LinearModel:
        """The same body with other loads, modes and offset of the same prescribed points; nothing is assembled again.

        Raises `ConfigurationError` when the conditions leave other displacements free than the model's own.
        """
        conditions.require_same_free(self.constraint)
        constraint, own = conditions.constraint, self.constraint
        if self.coupling and constraint.modes is own.modes and np.array_equal(constraint.offset, own.offset):
            return replace(self, conditions=conditions)  # other loads alone, and one coupling in memory
        both = [sparse.csr_matrix(part) for part in (constraint.modes, constraint.offset[:, None])]
        given = sparse.hstack(both, format="csr")
        coupling = tuple(sparse.csr_matrix(constraint.free.T @ (matrix @ given)) for matrix in self.stiffness)
        return replace(self, conditions=conditions, coupling=coupling)

    def same_stiffness(self, other: LinearModel) -> bool:
        """Whether it is the same body with the same free displacements, so that one factorisation serves both."""
        return self.free_stiffness is other.free_stiffness

    @property
    def load(self) -> NDArray[np.float64]:
        """Nodal forces f (n_dof,) of all loads, mN."""
        return self.conditions.forces(self.space)

    @property
    def free_load(self) -> NDArray[np.float64]:
        """F^T f (n_free,), mN."""
        return np.asarray(self.constraint.free.T @ self.load)

    @property
    def n_regions(self) -> int:
        """Number of moduli."""
        return len(self.regions)

    @property
    def n_modes(self) -> int:
        """Number of boundary modes and material modes."""
        return self.constraint.n_modes + self.material.n_modes

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the tissues in the order of the moduli."""
        return tuple(self.space.mesh.tissues[region].name for region in self.regions)

    def system(self, moduli: NDArray[np.float64]) -> LinearSystem:
        """The factorised system at moduli (n_regions,) kPa, for any number of solves; raises `SolverError`."""
        checked = checked_moduli(moduli, self.names)
        near_nullspace = self.constraint.free.T @ rigid_modes(self.space.points)
        # SciPy drops entries that cancel in a sum; an imaginary part keeps them, so that one pattern serves all moduli
        marked = (sparse.csr_matrix((k.data + 1j, k.indices, k.indptr), shape=k.shape) for k in self.free_stiffness)
        matrix = sparse.csr_matrix(weighted_sum(checked, tuple(marked)).real)
        matrix.data = matrix.data.copy()  # which else are every other number in memory, and keep the others
        return LinearSystem(
            self,
            checked,
            factorise(
                matrix,
                solver=self.solver,
                near_nullspace=np.asarray(near_nullspace),
                coarser=linear_displacements(self.space, self.constraint),
                right_hand_sides=FURTHER * self.n_regions + self.n_modes + 1,
            ),
        )

    def solve(self, moduli: NDArray[np.float64], coefficients: NDArray[np.float64]) -> LinearEquilibrium:
        """Equilibrium at moduli (n_regions,) kPa and mode coefficients (n_modes,); raises `SolverError`."""
        return self.system(moduli).solve(coefficients)

    def responses(self, moduli: NDArray[np.float64]) -> NDArray[np.float64]:
        """Displacement (n_dof, n_modes + 1) mm for each unit mode and, last, for the offset; raises `SolverError`."""
        return self.system(moduli).responses()

    def residual(self, moduli: NDArray[np.float64], displacements: NDArray[np.float64]) -> NDArray[np.float64]:
        """Out-of-balance forces F^T (K(E) u - f) (n_free, k), mN, of displacements u (n_dof, k) mm."""
        return np.asarray(self.constraint.free.T @ self.forces(moduli, displacements)) - self.free_load[:, None]

    def forces(self, moduli: NDArray[np.float64], displacements: NDArray[np.float64]) -> NDArray[np.float64]:
        """Nodal forces K(E) u (n_dof, k), mN, that hold displacements u (n_dof, k) mm at moduli (n_regions,) kPa."""
        total = np.zeros_like(displacements)
        for modulus, matrix in zip(moduli, self.stiffness, strict=True):
            total += modulus * (matrix @ displacements)
        return total

    def free_forces(self, moduli: NDArray[np.float64], free: NDArray[np.float64]) -> NDArray[np.float64]:
        """Forces F^T K(E) F z (n_free, k), mN, of free displacements z (n_free, k) mm at moduli (n_regions,) kPa."""
        largest, *others = sorted(zip(moduli, self.free_stiffness, strict=True), key=lambda pair: -pair[1].nnz)
        total = times(largest[1], free)  # a sum of the matrices would be copied at each addition
        total *= largest[0]
        for modulus, matrix in others:
            touched, within = touched_rows(matrix)
            total[touched] += modulus * times(within, free)
        return total

    def boundary_loads(
        self, moduli: NDArray[np.float64], values: NDArray[np.float64], directions: NDArray[np.float64] | None = None
    ) -> NDArray[np.float64]:
        """Loads (n_free, k), mN, whose responses are the free part of the tangent by moduli and boundary modes.

        At an equilibrium u (n_dof,) mm and moduli (n_regions,) kPa; directions (n_regions + n_boundary, k).
        """
        pairs, free = zip(moduli, self.stiffness, strict=True), self.constraint.free
        forces = [modulus * np.asarray(free.T @ np.asarray(matrix @ values)) for modulus, matrix in pairs]
        by_modulus, by_mode = np.stack(forces, axis=1), weighted_sum(moduli, self.coupling)[:, :-1]
        if directions is None:
            return -np.concatenate([by_modulus, by_mode.toarray()], axis=1)
        return -np.asarray(by_modulus @ directions[: self.n_regions] + by_mode @ directions[self.n_regions :])

    def material_forces(
        self, moduli: NDArray[np.float64], values: NDArray[np.float64], directions: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """Derivatives (n_dof, k), mN, of the nodal forces at u (n_dof,) mm along directions (n_material, k).

        Of the material coefficients; moduli (n_regions,) kPa. Along a single one they are one sum over the elements.
        """
        if self.elements is None or directions.shape[1] != 1:
            return self.by_material(moduli, values).along(directions)
        tissue, (lame, slopes) = self.space.mesh.region, self._lame(moduli, self.elements.dilatation)
        of = (self.elements, self.material, values, lame, directions[:, 0])
        return material_force_along(*of, by_poisson=slopes, tissue=tissue)[:, None]

    def by_material(self, moduli: NDArray[np.float64], values: NDArray[np.float64]) -> MaterialForces:
        """Derivatives of the nodal forces at u (n_dof,) mm and moduli (n_regions,) kPa by the material coefficients."""
        if self.elements is None:
            return MaterialForces(len(values), ())
        tissue, (lame, slopes) = self.space.mesh.region, self._lame(moduli, self.elements.dilatation)
        return material_forces(self.elements, self.material, values, lame, by_poisson=slopes, tissue=tissue)

    def material_by_region(self, values: NDArray[np.float64]) -> tuple[MaterialForces, ...]:
        """Those of each region alone, at 1 kPa, of the elements in which a coefficient changes anything."""
        every, tissue = self.by_material(np.ones(self.n_regions), values), self.space.mesh.region
        changed = np.any([np.diff(amounts.indptr) > 0 for _, amounts in every.parts], axis=0)
        return tuple(every.of_cells(np.flatnonzero((tissue == region) & changed)) for region in self.regions)

    def _lame(self, moduli: NDArray[np.float64], dilatation: Dilatation) -> tuple[Moduli, Moduli]:
        """Lame's constants (n_tets,) of all elements at moduli (n_regions,) kPa; their slopes by Poisson's ratio."""
        tissue = self.space.mesh.region
        lame, slopes = (np.zeros((3, len(tissue))) for _ in range(2))
        for modulus, region in zip(moduli, self.regions, strict=True):
            own, ratio = tissue == region, self.space.mesh.tissues[region].poisson_ratio
            lame[:, own] = modulus * np.array(lame_parts(ratio, dilatation))[:, None]
            slopes[:, own] = modulus * np.array(lame_parts_by_poisson(ratio, dilatation))[:, None]
        return Moduli(*lame), Moduli(*slopes)


@dataclass(frozen=True, slots=True)
class LinearSystem:
    """A linear model at fixed moduli (n_regions,) kPa with its factorisation."""

    model: LinearModel
    moduli: NDArray[np.float64]
    factorisation: Factorisation

    def of(self, model: LinearModel) -> LinearSystem:
        """The system of another state of the same body, with the factorisation that is there."""
        return replace(self, model=model)

    @property
    def response_counts(self) -> SolveCounts:
        """What this system and one call of `responses` cost together."""
        return SolveCounts(forward=self.model.constraint.n_modes + 1, factorisations=1)

    def responses(self, *, tolerance: float = EXACT) -> NDArray[np.float64]:
        """Displacement (n_dof, n_boundary + 1) mm for each boundary mode alone and, last, for offset and loads.

        tolerance: of the forces out of balance, relative.
        """
        constraint = self.model.constraint
        loads = weighted_sum(self.moduli, self.model.coupling).toarray()
        loads[:, -1] -= self.model.free_load
        given = np.column_stack([constraint.modes, constraint.offset])
        return np.asarray(given - constraint.free @ self.factorisation.solve(loads, tolerance=tolerance))

    def modulus_responses(
        self,
        displacements: NDArray[np.float64],
        regions: NDArray[np.int64] | None = None,
        *,
        tolerance: float = EXACT,
    ) -> NDArray[np.float64]:
        """Derivatives dw / d ln E_r (n, n_dof, k), mm, of equilibria w (n_dof, k) mm at these moduli.

        F K_ff^-1 F^T (-E_r K_r w) for r in `regions` (n,), by default all; without loads they sum to zero over all of
        them, for nothing sets a scale. tolerance: of the relative residual.
        """
        free = self.model.constraint.free
        chosen = np.arange(self.model.n_regions) if regions is None else regions
        forces = [self.moduli[r] * np.asarray(free.T @ (self.model.stiffness[r] @ displacements)) for r in chosen]
        solution = free @ self.factorisation.solve(-np.concatenate(forces, axis=1), tolerance=tolerance)
        return np.stack(np.split(np.asarray(solution), len(chosen), axis=1))

    def material_responses(
        self,
        values: NDArray[np.float64],
        directions: NDArray[np.float64] | None = None,
        *,
        tolerance: float = EXACT,
        dtype: type = np.float64,
    ) -> NDArray[Any]:
        """Derivatives du / dc_k (n_dof, n_material) mm at an equilibrium u (n_dof,) mm of homogeneous tissues.

        directions (n_material, k): sums of them instead; tolerance: of the relative residual; dtype: of the result,
        which is made some columns at a time.
        """
        along = np.eye(self.model.material.n_modes) if directions is None else directions
        free, by_material = self.model.constraint.free, self.model.by_material(self.moduli, values)
        found: NDArray[Any] = np.zeros((len(values), along.shape[1]), dtype=dtype)
        for some in together(len(values), along.shape[1]):
            forces = np.asarray(free.T @ by_material.along(along[:, some]))
            found[:, some] = free @ self.factorisation.solve(-forces, tolerance=tolerance)
        return found

    def single_responses(self, *, tolerance: float = EXACT) -> NDArray[np.float32]:
        """As `responses`, in single precision, some modes at a time: the largest thing there is, at half its size."""
        constraint = self.model.constraint
        loads = sparse.csc_matrix(weighted_sum(self.moduli, self.model.coupling))
        found = np.empty((len(constraint.offset), constraint.n_modes + 1), dtype=np.float32)
        found[:, :-1], found[:, -1] = constraint.modes, constraint.offset
        for part in together(*loads.shape):
            some = loads[:, part].toarray()
            if part.stop == loads.shape[1]:
                some[:, -1] -= self.model.free_load
            solution = self.factorisation.solve(some, tolerance=tolerance)
            found[:, part] -= times(constraint.free, solution)
        return found

    def solve(self, coefficients: NDArray[np.float64]) -> LinearEquilibrium:
        """Equilibrium at coefficients (n_modes,), dimensionless: one right-hand side, or two with material modes."""
        checked = checked_coefficients(coefficients, self.model.n_modes)
        constraint = self.model.constraint
        boundary, material = np.split(checked, [constraint.n_modes])
        loads = weighted_sum(self.moduli, self.model.coupling) @ np.append(boundary, 1.0) - self.model.free_load
        given = constraint.modes @ boundary + constraint.offset
        values = given - constraint.free @ self.factorisation.solve(loads[:, None])[:, 0]
        if np.any(material):
            values = values + self.material_responses(values, material[:, None])[:, 0]
        values.setflags(write=False)
        return LinearEquilibrium(self, checked, values)

    def error_bound(
        self,
        moduli: NDArray[np.float64],
        displacement: NDArray[np.float64],
        further: NDArray[np.float64] | float = 0.0,
    ) -> tuple[float, NDArray[np.float64]]:
        """Upper bound of the relative energy-norm error of an admissible displacement (n_dof,) mm at `moduli`.

        further (n_free, 1) mN: what a small displacement beside it leaves unbalanced, which counts as its residual.
        With it comes what it misses (n_dof,) mm, if K(E) is like the system's own K(E0). With the residual
        r = F^T (K(E) u - f) the error is exactly |r|_{K(E)^-1}; K(E0) stands in for K(E), as
        K(E) >= min_r(E_r / E0_r) K(E0): |e|_K / |u|_K <= sqrt(r^T K(E0)^-1 r / min_r(E_r / E0_r)) / |u|_K.
        Source: Patera & Rozza, Reduced Basis Approximation (2007), section 4.2 (min-theta approach).
        """
        forces, constraint = self.model.forces(moduli, displacement[:, None]), self.model.constraint
        residual = np.asarray(constraint.free.T @ forces) - self.model.free_load[:, None] + further
        missing = -self.factorisation.solve(residual, tolerance=OF_ERROR)
        energy = float(displacement @ forces[:, 0])
        least = float(np.min(np.asarray(moduli) / self.moduli))
        squared = float(-residual[:, 0] @ missing[:, 0]) / least / max(energy, np.finfo(float).tiny)
        return float(np.sqrt(max(squared, 0.0))), np.asarray(constraint.free @ missing)[:, 0]


@dataclass(frozen=True, slots=True)
class LinearEquilibrium(DenseEquilibrium):
    """The displacement at one system and one set of mode coefficients; implements `Equilibrium`."""

    system: LinearSystem
    coefficients: NDArray[np.float64]
    values: NDArray[np.float64]

    @property
    def counts(self) -> SolveCounts:
        """One factorisation and one right-hand side."""
        return SolveCounts(forward=1, factorisations=1)

    @property
    def tangent_counts(self) -> SolveCounts:
        """One right-hand side a modulus and a mode."""
        return SolveCounts(tangent=self.system.model.n_regions + self.system.model.n_modes)

    def tangent(self) -> NDArray[np.float64]:
        """T (n_dof, n_regions + n_modes), mm: columns du / d ln E_r = -F K_ff^-1 F^T E_r K_r u, then du / dq_k."""
        model, moduli, constraint = self.system.model, self.system.moduli, self.system.model.constraint
        forces = model.material_forces(moduli, self.values, np.eye(model.material.n_modes))
        material = -np.asarray(constraint.free.T @ forces)
        loads = np.concatenate([model.boundary_loads(moduli, self.values), material], axis=1)
        tangent = np.asarray(constraint.free @ self.system.factorisation.solve(loads))
        first = model.n_regions
        tangent[:, first : first + constraint.n_modes] += constraint.modes
        return tangent

    def adjoint(self, gradient: NDArray[np.float64]) -> NDArray[np.float64]:
        """T^T g (n_regions + n_modes,) for g (n_dof,): one solve K_ff p = F^T g, then p^T of the tangent's loads."""
        model, moduli, constraint = self.system.model, self.system.moduli, self.system.model.constraint
        load = np.asarray(constraint.free.T @ gradient)
        adjoint = self.system.factorisation.solve(load[:, None])[:, 0]
        by_boundary = np.asarray(model.boundary_loads(moduli, self.values).T @ adjoint)
        by_material = -model.by_material(moduli, self.values).work(np.asarray(constraint.free @ adjoint))
        result, first = np.concatenate([by_boundary, by_material]), model.n_regions
        result[first : first + constraint.n_modes] += constraint.modes.T @ gradient
        return result


def of_same_body(
    model: LinearModel, moduli: NDArray[np.float64], others: Iterable[LinearSystem]
) -> LinearSystem | None:
    """The system of a state's model at moduli (n_regions,) kPa by the factorisation of another state of its body.

    None where none of the `others` is one, or is of other moduli.
    """
    same = (other for other in others if model.same_stiffness(other.model) and np.array_equal(other.moduli, moduli))
    return next((other.of(model) for other in same), None)


def poisson_tangents(system: LinearSystem, values: NDArray[np.float64], dilatation: Dilatation) -> NDArray[np.float64]:
    """Columns du / d nu_r = -F K_ff^-1 F^T E_r dK_r/dnu u (k, n_dof, n_regions) mm of equilibria u (n_dof, k) mm.

    One column for each tissue. Equilibria of a body at one system's moduli, under whatever is prescribed; dilatation:
    that with which the model was made.
    """
    model, free, tissues = system.model, system.model.constraint.free, system.model.space.mesh.tissues

    def forces(of: tuple[float, int]) -> NDArray[np.float64]:
        """E_r F^T dK_r/dnu u (n_free, k), mN, of one region."""
        modulus, region = of
        by_poisson = stiffness_by_poisson(model.space, region, tissues[region].poisson_ratio, dilatation=dilatation)
        return np.asarray(free.T @ (modulus * (by_poisson @ values)))

    every = mapped(forces, zip(system.moduli.tolist(), model.regions, strict=True))
    moved = np.asarray(free @ system.factorisation.solve(-np.concatenate(every, axis=1)))
    return np.moveaxis(moved.reshape(len(moved), len(every), -1), 2, 0)


def linear_model(
    space: LagrangeSpace,
    constraint: Constraint,
    *,
    solver: str = "auto",
    dilatation: Dilatation = Dilatation.POINTWISE,
    loads: tuple[Load, ...] = (),
    material: MaterialModes = HOMOGENEOUS,
) -> LinearModel:
    """Assemble the linear model of all meshed tissues of `space.mesh`, with their Poisson's ratios.

    A pressure that follows its surface acts as on the surface at rest: to first order the body does not move.

    solver: a name of `palpate.mechanics.solvers.registry.SOLVERS` or "auto"; dilatation: that of the element, as
    `choose_element` gives it; material: how tissues may differ from homogeneous ones. Raises `ConfigurationError` when
    the constraint is of another space, `GeometryError` for tetrahedra without positive volume.
    """
    conditions, tissues = Conditions(constraint, loads), space.mesh.tissues
    conditions.require_space(space)

    def assembled(region: int) -> tuple[sparse.csr_matrix[np.float64], sparse.csr_matrix[np.float64]]:
        """K_r and F^T K_r F of one tissue."""
        whole = tissue_stiffness(space, region, tissues[region].poisson_ratio, dilatation=dilatation)
        return whole, restricted(whole, constraint.free)

    regions = tuple(number for number, tissue in enumerate(tissues) if tissue.meshed)
    stiffness, free_stiffness = zip(*mapped(assembled, regions), strict=True)
    elements = elements_of(space, LINEAR, dilatation) if material.n_modes else None
    model = LinearModel(space, conditions, regions, stiffness, free_stiffness, (), solver, elements, material)
    return model.with_conditions(conditions)


def touched_rows(matrix: sparse.csr_matrix[np.float64]) -> tuple[NDArray[np.int64], sparse.csr_matrix[np.float64]]:
    """Numbers (n_touched,) of the rows of a matrix (n, m) that have entries; these rows, sharing the entries."""
    touched = np.flatnonzero(np.diff(matrix.indptr))
    within = sparse.csr_matrix((len(touched), matrix.shape[1]), dtype=matrix.dtype)
    within.data, within.indices = matrix.data, matrix.indices
    within.indptr = np.append(matrix.indptr[touched], matrix.indptr[-1:])
    return touched, within


def weighted_sum(
    weights: NDArray[np.float64], matrices: tuple[sparse.csr_matrix[np.float64], ...]
) -> sparse.csr_matrix[np.float64]:
    """Sum over r of weights[r] (n_regions,) times matrices[r], (n, k) each, in the unit of their products."""
    smallest_first = sorted(zip(weights, matrices, strict=True), key=lambda term: term[1].nnz)
    (weight, matrix), *others = smallest_first  # each addition would copy the whole sum
    total = weight * matrix
    for weight, matrix in others:
        total = total + weight * matrix
    result = sparse.csr_matrix(total)
    result.sort_indices()
    return result
