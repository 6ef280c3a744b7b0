"""A reduced model that is exact where it matters: built at one place, extended where the estimate goes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import partial

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from palpate.approximation.contract import LinearisationPoint, ModelError, determined
from palpate.mechanics.forward import SolveCounts
from palpate.mechanics.linear_model import LinearModel, LinearSystem, of_same_body
from palpate.mechanics.reduced import Projection, ReducedModel, projection
from palpate.mechanics.solvers.conjugate_gradients import Product, conjugate_gradients, times
from palpate.mechanics.solvers.contract import Factorisation
from palpate.mechanics.solvers.registry import SOLVERS, CheckedFactorisation
from palpate.mesh.space import Constraint

SERIES = 40  # largest number of vectors of a series
FAR = 30.0  # largest over smallest ratio of moduli to the factorised ones, beyond which factorising anew is cheaper
FAR_ALONE = 300.0  # the same for a single right-hand side, which takes some 4 sqrt(spread) iterations
SNAPSHOT = 1e-5  # relative residual of basis vectors; their error is measured, and corrected, at each place
DISPLACEMENT, TANGENT = 3e-4, 1e-2  # of the reduced model's error, that a correction may leave
STALE = 0.3  # change of ln E after which all responses to the material modes are made anew
MANY = 128  # responses to material modes, as of a map, for which a new factorisation is cheaper than iterations
FAR_OFF = 3e-3  # missing share of the displacement, below which derivatives are wrong by as small a share
MAX_ITERATIONS = 120


@dataclass(frozen=True, slots=True)
class ReducedBasis:
    """A linear model projected on m displacements (n_free, m); implements `Approximation`.

    system: the last factorised one; counts: what it cost; place: where it was last made exact, None: nowhere yet;
    material_at (n_regions,) kPa: where all responses to the material modes were made, (0,) where none were yet.
    """

    projection: Projection
    system: LinearSystem
    counts: SolveCounts
    place: LinearisationPoint | None = None
    material_at: NDArray[np.float64] = field(default_factory=lambda: np.zeros(0))

    @property
    def full_model(self) -> LinearModel:
        """The model that is projected."""
        return self.projection.model

    @property
    def model(self) -> ReducedModel:
        """The reduced model."""
        return self.projection.reduced

    @property
    def constraint(self) -> Constraint:
        """What is prescribed to the model."""
        return self.full_model.constraint

    @property
    def factorisation(self) -> Factorisation:
        """That of the system that was factorised last."""
        return self.system.factorisation

    @property
    def trust_radius(self) -> float:
        """A projection holds however far."""
        return np.inf

    @property
    def derivatives_at(self) -> NDArray[np.float64] | None:
        """Moduli (n_regions,) kPa where it was last made exact with its derivatives."""
        return None if self.place is None or self.place.directions is None else self.place.moduli

    def update(self, at: LinearisationPoint, others: Sequence[ReducedBasis] = ()) -> ReducedBasis:
        """Add what the reduced model misses at a place: of the displacement there, and of its derivatives.

        Both are corrections by conjugate gradients with the factorisation that is there, from the reduced answers on;
        where it is none, or the moduli are far from its own, with a new one, which other states of the body share. The
        derivatives, sought together with the
        displacement, are those of the reduced one, and of what it missed where that is no small share. Raises
        `SolverError`.
        """
        model, near, sharper = self.full_model, self.system, self
        direct = isinstance(near.factorisation, CheckedFactorisation) and SOLVERS[near.factorisation.solver].direct
        ratios, every = at.moduli / near.moduli, at.directions is not None and self._stale(at)
        many = every and model.material.n_modes > MANY
        far = FAR if at.directions is not None else FAR_ALONE
        # a solver that iterates is no preconditioner; for many right-hand sides a new factorisation pays
        if many or not direct or ratios.max() >= far * ratios.min():
            shared = of_same_body(model, at.moduli, (other.system for other in others))
            near = shared or model.system(at.moduli)
            sharper = replace(self, system=near, counts=self.counts + SolveCounts(factorisations=int(not shared)))
        displacement, along = self._homogeneous(at), _Directions.at(at, model, every=every)
        product = partial(model.free_forces, at.moduli)
        new = int(not at.same_as(self.place))  # whether the displacement is solved for, too

        def solved(rhs: NDArray[np.float64], tolerance: float | NDArray[np.float64]) -> NDArray[np.float64]:
            """Solution (n_free, k) mm at the place to a relative residual, one or (k,)."""
            nearly = near.factorisation.nearly
            return conjugate_gradients(product, rhs, nearly, tolerance=tolerance, max_iterations=MAX_ITERATIONS)[0]

        sought = -model.residual(at.moduli, displacement[:, None])[:, :new]
        loads = np.concatenate([sought, self._lacking(at, displacement, along, product)], axis=1)
        if loads.shape[1]:
            missing = solved(loads, np.array([DISPLACEMENT] * new + [TANGENT] * along.number))
            cost = SolveCounts(forward=new, tangent=along.number)
            late = np.asarray(model.constraint.free @ missing[:, :new])
            if along.number and np.linalg.norm(late) > FAR_OFF * np.linalg.norm(displacement):
                missing[:, new:] += solved(along.by_displacement(model).loads(model, at.moduli, late[:, 0]), TANGENT)
                cost += SolveCounts(tangent=along.number)
            last = new + along.boundary.shape[1]
            material = _changed(along.material, at.metric, missing[:, last:], every=every)
            responses = self.model.output_material + times(model.constraint.free, material)
            sharper = sharper.with_material(responses, at.moduli if every else self.material_at)
            sharper = _extended(replace(sharper, place=at), missing[:, :last], cost)
        return sharper

    @property
    def error_counts(self) -> SolveCounts:
        """One right-hand side with the last factorisation."""
        return SolveCounts(forward=1)

    def error(self, at: LinearisationPoint) -> ModelError:
        """Upper bound of the displacement's relative error in energy (see `LinearSystem.error_bound`).

        Of its parts, too, that follow the material modes.
        """
        model, displacement = self.full_model, self._homogeneous(at)
        material = at.coefficients[model.constraint.n_modes :, None]
        if not np.any(material):
            return ModelError(*self.system.error_bound(at.moduli, displacement))
        forces = model.material_forces(at.moduli, displacement, material)
        whole = displacement + (self.model.output_material @ material)[:, 0]
        return ModelError(*self.system.error_bound(at.moduli, whole, np.asarray(model.constraint.free.T @ forces)))

    def with_material(self, responses: NDArray[np.float64], moduli: NDArray[np.float64]) -> ReducedBasis:
        """With the responses (n_dof, n_material) mm to the material modes at moduli (n_regions,) kPa."""
        return replace(self, projection=self.projection.with_material(responses), material_at=moduli)

    def _stale(self, at: LinearisationPoint) -> bool:
        """Whether responses to the material modes are not there yet, or of far from a place that asks for them all."""
        if not self.full_model.material.n_modes:
            return False
        if not len(self.material_at):
            return True
        return at.all_material and bool(np.abs(np.log(at.moduli / self.material_at)).max() > STALE)

    def _homogeneous(self, at: LinearisationPoint) -> NDArray[np.float64]:
        """The displacement (n_dof,) mm at a place as it would be of homogeneous tissues."""
        boundary = self.full_model.constraint.n_modes
        of_boundary = np.where(np.arange(len(at.coefficients)) < boundary, at.coefficients, 0.0)
        return self.model.solve(at.moduli, of_boundary).values

    def _lacking(
        self, at: LinearisationPoint, displacement: NDArray[np.float64], along: _Directions, product: Product
    ) -> NDArray[np.float64]:
        """What the derivatives that are there leave of their loads (n_free, k), mN, at a place along directions.

        displacement (n_dof,) mm; product: with the stiffness there.
        """
        if not along.number:
            return np.zeros((self.constraint.free.shape[1], 0))
        loads, first = along.loads(self.full_model, at.moduli, displacement), along.boundary.shape[1]
        amplitudes = self.model.system(at.moduli).backward(self.projection.components(loads[:, :first]))
        material = np.asarray(self.constraint.free.T @ (self.model.output_material @ along.material))
        return loads - product(np.concatenate([self.projection.spanned(amplitudes), material], axis=1))

    def with_modulus_series(self, coefficients: NDArray[np.float64], by_theta: NDArray[np.float64]) -> ReducedBasis:
        """Add how the displacement at `coefficients` (n_modes,) changes with the parameters, to high order.

        by_theta (n_regions, n_parameters): derivatives of the log-moduli by the parameters. The repeated derivatives
        w -> K^-1 (-E_r K_r w) of all orders up to a number span the dependence on the moduli over a wide range, for K
        is affine in them (moment matching; Grimme 1997). One right-hand side each, no factorisation.
        """
        model, system, regions = self.full_model, self.system, np.flatnonzero(by_theta.any(axis=1))
        n_parameters = by_theta.shape[1]
        level = self._homogeneous(LinearisationPoint(system.moduli, coefficients))[:, None]
        vectors: list[NDArray[np.float64]] = []
        while level.shape[1] * n_parameters + sum(v.shape[1] for v in vectors) <= SERIES:
            by_region = system.modulus_responses(level, regions=regions, tolerance=SNAPSHOT)
            level = np.concatenate([np.tensordot(column, by_region, axes=1) for column in by_theta[regions].T], axis=1)
            vectors.append(level)
        if not vectors:
            return self
        fresh = np.asarray(model.constraint.free.T @ np.concatenate(vectors, axis=1))
        return _extended(self, fresh, SolveCounts(tangent=fresh.shape[1]))

    def with_responses(self, moduli: NDArray[np.float64], coefficients: NDArray[np.float64]) -> ReducedBasis:
        """Add all responses at moduli (n_regions,) kPa and the modulus derivatives of the displacement there.

        A factorisation and a right-hand side a mode: `update` costs a fraction, but serves the given place only.
        """
        system = self.full_model.system(moduli)
        responses = system.responses()
        solution = responses @ np.append(coefficients[: self.constraint.n_modes], 1.0)
        derivatives = system.modulus_responses(solution[:, None])[:, :, 0].T
        free = self.constraint.free
        fresh = np.concatenate([free.T @ responses, free.T @ derivatives], axis=1)
        cost = system.response_counts + SolveCounts(tangent=self.full_model.n_regions)
        return _extended(replace(self, system=system), fresh, cost)


@dataclass(frozen=True, slots=True)
class _Directions:
    """Those of (ln E, boundary modes) (n_regions + n_boundary, k), and of material modes (n_material, l).

    Along the latter, all of them or those of the place, the coefficients there are one, too: of their part of the
    displacement nothing is missed then.
    """

    boundary: NDArray[np.float64]
    material: NDArray[np.float64]

    @classmethod
    def at(cls, place: LinearisationPoint, model: LinearModel, *, every: bool) -> _Directions:
        """The directions of a place, none where it has none; every: with all material modes."""
        first, modes = model.n_regions + model.constraint.n_modes, np.zeros((model.material.n_modes, 0))
        if place.directions is None:
            return cls(np.zeros((first, 0)), modes)
        if every:
            modes = np.eye(len(modes))
        elif place.metric is not None and len(modes):
            modes = np.column_stack([place.directions[first:], place.coefficients[model.constraint.n_modes :]])
            modes = modes[:, np.linalg.norm(modes, axis=0) > 0.0]
        return cls(place.directions[:first], modes)

    @property
    def number(self) -> int:
        """How many they are."""
        return int(self.boundary.shape[1] + self.material.shape[1])

    def by_displacement(self, model: LinearModel) -> _Directions:
        """Those along which loads depend on the displacement."""
        of_moduli = np.arange(len(self.boundary))[:, None] < model.n_regions
        return replace(self, boundary=np.where(of_moduli, self.boundary, 0.0))

    def loads(
        self, model: LinearModel, moduli: NDArray[np.float64], displacement: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """Loads (n_free, k + l), mN, of the derivatives at moduli (n_regions,) kPa and u (n_dof,) mm."""
        loads = model.boundary_loads(moduli, displacement, self.boundary)
        if not self.material.shape[1]:
            return loads
        forces = model.material_forces(moduli, displacement, self.material)
        return np.concatenate([loads, -np.asarray(model.constraint.free.T @ forces)], axis=1)


def reduced_basis(model: LinearModel, moduli: NDArray[np.float64]) -> ReducedBasis:
    """The model on its responses to every boundary mode at moduli (n_regions,) kPa; one factorisation."""
    system, free = model.system(moduli), sparse.csr_matrix(model.constraint.free.T)
    return basis_of(system, times(free, system.responses(tolerance=SNAPSHOT)), system.response_counts)


def basis_of(system: LinearSystem, snapshots: NDArray[np.float64], counts: SolveCounts) -> ReducedBasis:
    """A system's model on free displacements (n_free, k) mm, which are overwritten, with what these, and it, cost."""
    return ReducedBasis(projection(system.model, snapshots, overwrite=True), system, counts)


def _changed(
    along: NDArray[np.float64], metric: NDArray[np.float64] | None, missing: NDArray[np.float64], *, every: bool
) -> NDArray[np.float64]:
    """Change (n_free, n_material) mm of the responses U to the material modes that are exact along directions D.

    missing (n_free, k): C - U D with the exact C. They become U + (C - U D) (D^T H D)^+ D^T H with the metric H (n, n)
    of all, as those of an `Expansion`; with every mode along itself C.
    """
    if every:
        return missing
    if metric is None or not along.shape[1]:
        return np.zeros((len(missing), len(along)))
    own = metric[-len(along) :, -len(along) :]
    with determined():
        return np.asarray(missing @ (np.linalg.pinv(along.T @ own @ along, hermitian=True) @ (along.T @ own)))


def _extended(basis: ReducedBasis, snapshots: NDArray[np.float64], cost: SolveCounts) -> ReducedBasis:
    return replace(basis, projection=basis.projection.extended(snapshots), counts=basis.counts + cost)
