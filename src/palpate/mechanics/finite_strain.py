"""Equilibrium of several tissues under any law, at finite strain, with its exact derivatives.

An admissible u = F z + M q + o is in equilibrium when F^T R(u) = 0 with R = internal - external forces. With the
tangent K = dR/du and K_ff = F^T K F the derivatives there are du/dp = -F K_ff^-1 F^T dR/dp for a constant p of a
tissue, and du/dq = M - F K_ff^-1 F^T K M.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from palpate.errors import ConfigurationError, NotConverged
from palpate.mechanics.balance import TissueBalance
from palpate.mechanics.boundary import Conditions
from palpate.mechanics.dilatation import Dilatation
from palpate.mechanics.forward import SolveCounts, checked_coefficients, checked_moduli
from palpate.mechanics.hyperelastic import Elements, Moduli, elements_of
from palpate.mechanics.laws.contract import Law
from palpate.mechanics.linearised import TIGHT, LinearisedSystem
from palpate.mechanics.loads import Load
from palpate.mechanics.material import HOMOGENEOUS, MaterialForces, MaterialModes, material_forces
from palpate.mechanics.newton import NewtonPath, NewtonSettings, follow
from palpate.mechanics.pattern import BlockPattern, Restriction, Stiffness, block_pattern, restriction
from palpate.mechanics.solvers.conjugate_gradients import times
from palpate.mechanics.solvers.contract import Factorisation, together
from palpate.mechanics.stiffness import lame_parts, lame_parts_by_poisson
from palpate.mesh.space import Constraint, LagrangeSpace

Array = NDArray[np.float64]

FACTORISATION_IN_SOLVES = 30  # right-hand sides that take as long as a factorisation
NEARLY_INCOMPRESSIBLE = 0.4999  # largest Poisson's ratio that a coefficient may lead to
LACKING = 1e-2  # relative residual of a correction to the derivatives of a similar state
ESTIMATED = 1e-4  # relative residual of a correction by another state's stiffness
REFINEMENTS = 12  # solutions with an old factorisation that replace one with the exact factorisation


@dataclass(frozen=True, slots=True)
class FiniteStrainModel:
    """All meshed tissues of a body under one law and the conditions of one state; implements `ForwardModel`.

    regions: indices in `space.mesh.tissues` of the meshed ones; element_region (n_tets,): place in `regions` of each
    tetrahedron; poisson_ratios (n_regions,), dimensionless; material: how the tissues may differ from homogeneous ones.
    Coefficients are those of the boundary modes, then of the material modes.
    """

    space: LagrangeSpace
    conditions: Conditions
    elements: Elements
    regions: tuple[int, ...]
    element_region: NDArray[np.int64]
    poisson_ratios: Array
    pattern: BlockPattern
    restriction: Restriction
    settings: NewtonSettings
    material: MaterialModes = HOMOGENEOUS

    @property
    def constraint(self) -> Constraint:
        """What is prescribed."""
        return self.conditions.constraint

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

    def solve(
        self,
        moduli: NDArray[np.float64],
        coefficients: NDArray[np.float64],
        *,
        start: Array | None = None,
        nearby: Factorisation | None = None,
    ) -> FiniteStrainEquilibrium:
        """Equilibrium at moduli (n_regions,) kPa and mode coefficients (n_modes,).

        The way begins at `start` (n_points, 3) mm, or at rest; `nearby`, the factorisation of a like stiffness (that of
        another equilibrium, or of the `LinearModel` with the same dilatation), saves making one. Raises `NotConverged`
        with the reason; `attempt` gives the state that was reached instead.
        """
        equilibrium = self.attempt(moduli, coefficients, start=start, nearby=nearby)
        if not equilibrium.converged:
            raise NotConverged(equilibrium.reason)
        return equilibrium

    def attempt(
        self,
        moduli: NDArray[np.float64],
        coefficients: NDArray[np.float64],
        *,
        start: Array | None = None,
        nearby: Factorisation | None = None,
    ) -> FiniteStrainEquilibrium:
        """As `solve`, with moduli (n_regions,) and coefficients (n_modes,), but a failure returns the best state.

        It is then marked `converged` False, with the reason and the share of the motion that was reached.
        """
        checked, amounts = checked_moduli(moduli, self.names), checked_coefficients(coefficients, self.n_modes)
        boundary = amounts[: self.constraint.n_modes]
        balance = self.balance(checked, amounts[self.constraint.n_modes :])
        begin = np.zeros_like(self.space.points) if start is None else np.array(start, dtype=float)
        if begin.shape != self.space.points.shape or not np.all(np.isfinite(begin)):
            raise ConfigurationError(
                f"the start has the shape {begin.shape}; give a finite displacement {self.space.points.shape} in mm"
            )
        begin = begin.ravel()
        free = self.constraint.free
        given = self.constraint.modes @ boundary + self.constraint.offset
        now = begin - np.asarray(free @ np.asarray(free.T @ begin))
        path = follow(balance, begin, given - now, settings=self.settings, nearby=nearby)
        if path.converged:  # what is prescribed is met to the last digit
            path = replace(path, displacement=np.asarray(free @ np.asarray(free.T @ path.displacement)) + given)
        path.displacement.setflags(write=False)
        return FiniteStrainEquilibrium(self, balance, checked, amounts, path)

    def balance(self, moduli: NDArray[np.float64], material: NDArray[np.float64] | None = None) -> TissueBalance:
        """The forces at Young's moduli (n_regions,) kPa, as functions of the displacement.

        material (n_material,): coefficients of the material modes, by default of homogeneous tissues.
        """
        return TissueBalance(
            space=self.space,
            elements=self.elements,
            element_region=self.element_region,
            n_regions=self.n_regions,
            loads=self.conditions.loads,
            pattern=self.pattern,
            restriction=self.restriction,
            solver=self.settings.solver,
            moduli=self.moduli_of(moduli, material),
        )

    def moduli_of(self, moduli: NDArray[np.float64], material: NDArray[np.float64] | None = None) -> Moduli:
        """Lame's constants of every element at Young's moduli (n_regions,) kPa and material coefficients."""
        return self._spread(moduli, material, lame_parts)

    def moduli_by_poisson(self, moduli: NDArray[np.float64], material: NDArray[np.float64] | None = None) -> Moduli:
        """Derivatives of every element's Lame constants with respect to its nu, as `moduli_of`."""
        return self._spread(moduli, material, lame_parts_by_poisson)

    def material_forces(
        self, values: NDArray[np.float64], moduli: NDArray[np.float64], material: NDArray[np.float64]
    ) -> MaterialForces:
        """Derivatives of the internal forces by the material's coefficients (n_material,).

        At u (n_dof,) mm and moduli (n_regions,) kPa.
        """
        return material_forces(
            self.elements,
            self.material,
            values,
            self.moduli_of(moduli, material),
            by_poisson=self.moduli_by_poisson(moduli, material),
            tissue=np.array(self.regions)[self.element_region],
        )

    def with_conditions(self, conditions: Conditions) -> FiniteStrainModel:
        """The same body with other loads, modes and offset of the same prescribed points.

        Raises `ConfigurationError` when the conditions leave other displacements free.
        """
        conditions.require_same_free(self.constraint)
        return replace(self, conditions=conditions)

    def to_tolerance(self, tolerance: float) -> FiniteStrainModel:
        """The same body, its equilibria found to another `tolerance` of the forces (see `NewtonSettings`)."""
        return replace(self, settings=replace(self.settings, tolerance=tolerance))

    def _spread(
        self, moduli: Array, material: Array | None, of_ratio: Callable[[float, Dilatation], tuple[float, float, float]]
    ) -> Moduli:
        ratios = dict(zip(self.regions, self.poisson_ratios.tolist(), strict=True))
        scale = np.ones(len(self.element_region))
        if material is not None and self.material.n_modes:
            scale = self.material.scale(material)
            for tissue, by in self.material.poisson_shifts(material).items():
                ratios[tissue] = min(ratios[tissue] + by, NEARLY_INCOMPRESSIBLE)
        units = [of_ratio(ratio, self.elements.dilatation) for ratio in ratios.values()]
        mu, pointwise, mean = scale * (moduli[:, None] * np.array(units)).T[:, self.element_region]
        return Moduli(mu, pointwise, mean)


@dataclass(frozen=True, slots=True)
class FiniteStrainEquilibrium:
    """The state at the end of a path; implements `Equilibrium`. Its derivatives exist only when it is `converged`."""

    model: FiniteStrainModel = field(repr=False)
    balance: TissueBalance = field(repr=False)
    moduli: NDArray[np.float64]
    coefficients: NDArray[np.float64]
    path: NewtonPath = field(repr=False)

    @property
    def values(self) -> NDArray[np.float64]:
        """Displacement u (n_dof,) mm."""
        return self.path.displacement

    @property
    def displacement(self) -> NDArray[np.float64]:
        """Displacement u (n_points, 3) mm."""
        return self.path.displacement.reshape(-1, 3)

    @property
    def converged(self) -> bool:
        """Whether the body is in equilibrium under the whole motion and load."""
        return self.path.converged

    @property
    def reason(self) -> str:
        """A sentence: how the iteration ended; of a failure, at which step and with which element."""
        return self.path.reason

    @property
    def fraction(self) -> float:
        """The share of the motion and load that was reached; 1 when converged."""
        return self.path.fraction

    @property
    def counts(self) -> SolveCounts:
        """What the way to this equilibrium cost."""
        return self.path.counts

    @property
    def tangent_counts(self) -> SolveCounts:
        """One right-hand side a modulus and a mode, and a factorisation where they are many."""
        n = self.model.n_regions + self.model.n_modes
        return SolveCounts(tangent=n, factorisations=int(self._many(n)))

    @property
    def factorisation(self) -> Factorisation | None:
        """The last factorisation, of a tangent stiffness near this state's: for `nearby` of another solve."""
        return self.path.factorisation

    def error_estimate(
        self, moduli: NDArray[np.float64], coefficients: NDArray[np.float64], displacement: NDArray[np.float64]
    ) -> tuple[float, NDArray[np.float64]]:
        """Estimated relative error in energy of a displacement (n_dof,) mm at other moduli and coefficients (n_modes,).

        It is that of one correction -K^-1 r (n_dof,) mm by the residual r, K the stiffness of this equilibrium, which
        comes with it: one right-hand side. Infinite where no factorisation of K is kept, and where an element is turned
        inside out, which no law answers.
        """
        balance = self.model.balance(moduli, coefficients[self.model.constraint.n_modes :])
        if self.factorisation is None or balance.smallest_volume(displacement) <= 0.0:
            return np.inf, np.zeros_like(displacement)
        residual = np.asarray(balance.free.T @ balance.residual(displacement)[0])
        correction = -self.factorisation.solve(residual[:, None], tolerance=ESTIMATED)[:, 0]
        internal = balance.region_forces(displacement, balance.moduli).sum(axis=1)
        squared = abs(residual @ correction) / max(abs(float(internal @ displacement)), np.finfo(float).tiny)
        missing = np.asarray(balance.free @ correction)
        return (float(np.sqrt(squared)) if np.isfinite(squared) else np.inf), missing

    def refactorised(self) -> FiniteStrainEquilibrium:
        """The same state with the factorisation of its own tangent stiffness; raises `NotConverged`.

        Worth its price before `tangent` when another solve follows that can use it as `nearby`.
        """
        path = self.path.with_factorisation(self.balance.factorise(self._stiffness()))
        return replace(self, path=replace(path, exact=True))

    def tangent(self, *, tolerance: float = TIGHT) -> NDArray[np.float64]:
        """T (n_dof, n_regions + n_modes), mm: columns du / d ln E_r, then du / dq_k; raises `NotConverged`.

        tolerance: of the relative residual of each.
        """
        stiffness = self._stiffness()
        first, modes = self.model.n_regions, self.model.constraint.modes
        each, along = np.eye(first + self.model.n_modes), self._parameter_forces(stiffness)
        system, result = self._system(stiffness, len(each)), np.zeros((len(self.values), len(each)))
        for some in together(len(self.values), len(each)):
            loads = -np.asarray(self.balance.free.T @ along(each[:, some]))
            result[:, some] = np.asarray(self.balance.free @ system.solve(loads, tolerance=tolerance))
        result[:, first : first + modes.shape[1]] += modes
        return result

    def tangent_along(self, directions: NDArray[np.float64], guess: NDArray[np.float64]) -> NDArray[np.float64]:
        """Derivatives (n_dof, k) mm along directions (n_regions + n_modes, k) of (ln E, q); raises `NotConverged`.

        guess (n_dof, k) mm: the same of a like state; what it lacks is found to a hundredth, without a factorisation.
        """
        stiffness, free = self._stiffness(), self.balance.free
        first, modes = self.model.n_regions, self.model.constraint.modes
        prescribed = np.asarray(modes @ directions[first : first + modes.shape[1]])
        system, known = self._system(stiffness, 1), np.asarray(free.T @ guess)
        lacking = -np.asarray(free.T @ self._parameter_forces(stiffness)(directions)) - system.matrix @ known
        return np.asarray(free @ (known + system.solve(lacking, tolerance=LACKING))) + prescribed

    def poisson_tangents(self, *, tolerance: float = TIGHT) -> NDArray[np.float64]:
        """Columns du / d nu_r (n_dof, n_regions) mm, to a relative residual of `tolerance`; raises `NotConverged`."""
        stiffness = self._stiffness()
        slopes = self.model.moduli_by_poisson(self.moduli, self.coefficients[self.model.constraint.n_modes :])
        loads = -np.asarray(self.balance.free.T @ self.balance.region_forces(self.values, slopes))
        system = self._system(stiffness, loads.shape[1], tolerance)
        return np.asarray(self.balance.free @ system.solve(loads, tolerance=tolerance))

    def adjoint(self, gradient: NDArray[np.float64]) -> NDArray[np.float64]:
        """T^T g (n_regions + n_modes,) for g (n_dof,), by one adjoint solve; raises `NotConverged`."""
        stiffness = self._stiffness()
        load = np.asarray(self.balance.free.T @ gradient)
        dual = self._system(stiffness, 1).transposed().solve(load[:, None])[:, 0]
        everywhere, modes = np.asarray(self.balance.free @ dual), self.model.constraint.modes
        by_modulus = -self.balance.region_forces(self.values, self.balance.moduli).T @ everywhere
        by_mode = modes.T @ (gradient - stiffness.T @ everywhere)
        return np.concatenate([by_modulus, by_mode, -self._by_material.work(everywhere)])

    def _stiffness(self) -> Stiffness:
        if not self.converged:
            raise NotConverged(f"a state out of equilibrium has no derivatives: {self.reason}")
        return self.balance.stiffness(self.values)

    def _many(self, n: int, tolerance: float = TIGHT) -> bool:
        """Whether a new factorisation costs less than to refine n solutions of the old one to a relative residual."""
        if self.path.factorisation is None:
            return True
        refinements = REFINEMENTS * np.log(tolerance) / np.log(TIGHT)
        return not self.path.exact and n * (refinements - 1.0) > FACTORISATION_IN_SOLVES

    def _system(self, stiffness: Stiffness, n: int, tolerance: float = TIGHT) -> LinearisedSystem:
        """The linear system at this state, ready for n right-hand sides."""
        old = self.path.factorisation
        ready = self.balance.factorise(stiffness) if old is None or self._many(n, tolerance) else old
        if isinstance(ready, LinearisedSystem):
            ready = ready.nearby
        return LinearisedSystem(self.balance.restricted(stiffness), ready, symmetric=self.balance.symmetric)

    def _parameter_forces(self, stiffness: Stiffness) -> Callable[[Array], Array]:
        """[dR / d ln E_r, K M, dR / dc_k] d (n_dof, k), mN, as a function of directions d (n_regions + n_modes, k)."""
        by_region, by_material = self.balance.region_forces(self.values, self.balance.moduli), self._by_material
        ends = np.cumsum([self.model.n_regions, self.model.constraint.n_modes])
        modes = self.model.constraint.modes
        moving = np.flatnonzero(modes.any(axis=1))  # what is prescribed, at the body's border: a small part
        by_moving, modes = sparse.csr_matrix(stiffness.tocsr()[:, moving]), modes[moving]

        def along(directions: Array) -> Array:
            """Those of several directions."""
            of_moduli, of_modes, of_material = np.split(directions, ends)
            forces = np.asarray(by_region @ of_moduli)
            moved, uneven = of_modes.any(axis=0), of_material.any(axis=0)  # of unit vectors each is of one part
            forces[:, moved] += times(by_moving, np.asarray(modes @ of_modes[:, moved]))
            forces[:, uneven] += by_material.along(of_material[:, uneven])
            return forces

        return along

    @property
    def _by_material(self) -> MaterialForces:
        """Derivatives of R by the material's coefficients."""
        material = self.coefficients[self.model.constraint.n_modes :]
        return self.model.material_forces(self.values, self.moduli, material)


def finite_strain_model(
    space: LagrangeSpace,
    constraint: Constraint,
    law: Law,
    *,
    dilatation: Dilatation = Dilatation.BLENDED,
    loads: tuple[Load, ...] = (),
    material: MaterialModes = HOMOGENEOUS,
    settings: NewtonSettings | None = None,
    strained: NDArray[np.float64] | None = None,
) -> FiniteStrainModel:
    """The model of all meshed tissues of `space.mesh` under `law`, with their Poisson's ratios.

    strained (n_points, 3) mm: where the body was seen, less where it is free of stress (see `unloaded_displacement`);
    displacements, forces and loads then are what is added to those of the state that was seen. Raises
    `ConfigurationError` when the constraint is of another space, `GeometryError` for tetrahedra without
    positive volume.
    """
    conditions, tissues = Conditions(constraint, loads), space.mesh.tissues
    conditions.require_space(space)
    regions = tuple(number for number, tissue in enumerate(tissues) if tissue.meshed)
    pattern = block_pattern(space.cells, len(space.points))
    blocks = np.ones((space.cells.size * space.cells.shape[1], 9))
    elements = elements_of(space, law, dilatation)
    return FiniteStrainModel(
        space=space,
        conditions=conditions,
        elements=elements if strained is None else elements.unloaded(strained),
        regions=regions,
        element_region=np.searchsorted(regions, space.mesh.region),
        poisson_ratios=np.array([tissues[region].poisson_ratio for region in regions]),
        pattern=pattern,
        restriction=restriction(constraint, pattern.assemble(blocks)),
        settings=settings or NewtonSettings(),
        material=material,
    )
