"""A reduced model that is exact where it matters: built at one place, extended where the estimate goes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from palpate.approximation.contract import LinearisationPoint, ModelError
from palpate.mechanics.forward import SolveCounts
from palpate.mechanics.linear_model import LinearModel, LinearSystem
from palpate.mechanics.reduced import Projection, ReducedModel, projection
from palpate.mechanics.solvers.conjugate_gradients import Product, conjugate_gradients, times
from palpate.mechanics.solvers.contract import Factorisation
from palpate.mechanics.solvers.registry import SOLVERS, CheckedFactorisation
from palpate.mesh.space import Constraint
from palpate.parallel import mapped

SERIES = 40  # largest number of vectors of a series
FAR = 30.0  # largest over smallest ratio of moduli to the factorised ones, beyond which factorising anew is cheaper
FAR_ALONE = 300.0  # the same for a single right-hand side, which takes some 4 sqrt(spread) iterations
SNAPSHOT = 1e-5  # relative residual of basis vectors; their error is measured, and corrected, at each place
DISPLACEMENT, TANGENT = 3e-4, 1e-2  # of the reduced model's error, that a correction may leave
REMADE_AFTER = 1.0  # change of ln E after which all responses to the material modes are made anew
ITERATIONS = 3.0, 5.0  # of conjugate gradients: at least, and for each unit of sqrt(spread) - 1 of moduli's ratios
MAKING = 2.5e-5  # seconds an unknown that a factorisation takes beside elimination: its matrix, and its probes
MISSING = 3e-3  # share of the displacement, below which derivatives are wrong by as small a share
MAX_ITERATIONS = 120
FEW = 12  # right-hand sides, of which an iteration takes no less time: the factor is read once
TOGETHER = 64  # right-hand sides of several states that are solved for together


@dataclass(frozen=True, slots=True)
class ReducedBasis:
    """A linear model projected on m displacements (n_free, m); implements `Approximation`.

    system: the last factorised one; counts: what it cost; place: where it was last made exact, None: nowhere yet;
    material_at (n_regions,) kPa: where all responses to the material modes were made last, (0,) where none were yet.
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

    def update(self, at: LinearisationPoint) -> ReducedBasis:
        """The basis made exact at a place, as `update_all` does it for the states of a body together."""
        return self.update_all([self], [at])[0]

    @classmethod
    def update_all(cls, bases: Sequence[ReducedBasis], points: Sequence[LinearisationPoint]) -> list[ReducedBasis]:
        """Add what reduced models miss at their places: of the displacement there, and of its derivatives.

        Both are corrections by conjugate gradients with the factorisation that is there, from the reduced answers on;
        where it is none, or the moduli are so far from its own that a new one costs less, with that. States of one body
        at the same moduli share it, and are solved for together. The derivatives, sought together with the
        displacement, are those of the reduced one, and of what it missed where that is no small share. Raises
        `SolverError`.
        """
        found = [_Missing.of(basis, at) for basis, at in zip(bases, points, strict=True)]
        sharper, left = dict[int, ReducedBasis](), list(range(len(found)))
        while left:
            alike = [i for i in left if found[i].alike(found[left[0]])]
            left = [i for i in left if i not in alike]
            near, made = _near([found[i] for i in alike])
            if made:
                counts = found[alike[0]].basis.counts + SolveCounts(factorisations=1)
                found[alike[0]] = replace(found[alike[0]], basis=replace(found[alike[0]].basis, counts=counts))
            while alike:  # some of them at a time, as far as right-hand sides have room
                numbers = np.cumsum([found[i].number for i in alike])
                some = alike[: max(1, int(np.searchsorted(numbers, TOGETHER, side="right")))]
                alike = alike[len(some) :]
                sharper |= zip(some, _corrected([found[i] for i in some], near), strict=True)
        return [sharper[i] for i in range(len(found))]

    @property
    def error_counts(self) -> SolveCounts:
        """One right-hand side with the last factorisation."""
        return SolveCounts(forward=1)

    def error(self, at: LinearisationPoint) -> ModelError:
        """Upper bound of the displacement's relative error in energy (see `LinearSystem.error_bound`).

        Of its parts, too, that follow the material modes.
        """
        model, displacement = self.full_model, self.homogeneous(at)
        material = at.coefficients[model.constraint.n_modes :, None]
        if not np.any(material):
            return ModelError(*self.system.error_bound(at.moduli, displacement))
        forces = model.material_forces(at.moduli, displacement, material)
        whole = self.model.solve(at.moduli, at.coefficients).values
        return ModelError(*self.system.error_bound(at.moduli, whole, np.asarray(model.constraint.free.T @ forces)))

    def with_material(
        self, responses: NDArray[np.floating[Any]], moduli: NDArray[np.float64], values: NDArray[np.float64]
    ) -> ReducedBasis:
        """With the responses (n_dof, n_material) mm to the material modes at moduli (n_regions,) kPa.

        values (n_dof,) mm: the displacement there of homogeneous tissues. Elsewhere the responses follow the moduli as
        the projection tells, for what the modes do to that displacement.
        """
        found = self.projection.at_displacement(values)
        fresh = np.asarray(self.constraint.free.T @ responses, dtype=np.float64)
        return replace(self, projection=found.extended(fresh), material_at=moduli)

    def at_place(self) -> ReducedBasis:
        """With the forces of material modes at its place."""
        assert self.place is not None, "a basis is at a place once it is made exact there"
        return replace(self, projection=self.projection.at_displacement(self.homogeneous(self.place)))

    def lacks_material(self, at: LinearisationPoint) -> bool:
        """Whether responses to the material modes are not there yet, or of far from a place that asks for them all."""
        if not self.full_model.material.n_modes:
            return False
        if not len(self.material_at):
            return True
        return at.all_material and bool(np.abs(np.log(at.moduli / self.material_at)).max() > REMADE_AFTER)

    def homogeneous(self, at: LinearisationPoint) -> NDArray[np.float64]:
        """The displacement (n_dof,) mm at a place as it would be of homogeneous tissues."""
        boundary = self.full_model.constraint.n_modes
        of_boundary = np.where(np.arange(len(at.coefficients)) < boundary, at.coefficients, 0.0)
        return self.model.solve(at.moduli, of_boundary).values

    def with_modulus_series(self, coefficients: NDArray[np.float64], by_theta: NDArray[np.float64]) -> ReducedBasis:
        """Add how the displacement at `coefficients` (n_modes,) changes with the parameters, to high order.

        by_theta (n_regions, n_parameters): derivatives of the log-moduli by the parameters. The repeated derivatives
        w -> K^-1 (-E_r K_r w) of all orders up to a number span the dependence on the moduli over a wide range, for K
        is affine in them (moment matching; Grimme 1997). One right-hand side each, no factorisation.
        """
        model, system, regions = self.full_model, self.system, np.flatnonzero(by_theta.any(axis=1))
        n_parameters = by_theta.shape[1]
        level = self.homogeneous(LinearisationPoint(system.moduli, coefficients))[:, None]
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
class _Missing:
    """What a basis is asked for at a place: the displacement, and derivatives along directions of (ln E, coefficients).

    along (n_regions + n_modes, k): the directions, and the material's coefficients there; every: whether derivatives by
    all material modes are among them; displacement (n_dof,) mm: that of the reduced model, of homogeneous tissues; new:
    1 where the displacement is sought, too, else 0.
    """

    basis: ReducedBasis
    at: LinearisationPoint
    every: bool
    along: NDArray[np.float64]
    displacement: NDArray[np.float64]
    new: int

    @classmethod
    def of(cls, basis: ReducedBasis, at: LinearisationPoint) -> _Missing:
        """What it is of a basis at a place."""
        model, every = basis.full_model, at.directions is not None and basis.lacks_material(at)
        first, size = len(at.moduli) + model.constraint.n_modes, len(at.moduli) + model.n_modes
        along = np.zeros((size, 0))
        if every and at.directions is not None:
            along = np.concatenate([at.directions, np.eye(size)[:, first:]], axis=1)
        elif at.directions is not None:
            own = np.concatenate([np.zeros(first), at.coefficients[model.constraint.n_modes :]])[:, None]
            along = np.concatenate([at.directions, own[:, own.any(axis=0)]], axis=1)
        return cls(basis, at, every, along, basis.homogeneous(at), int(not at.same_as(basis.place)))

    @property
    def number(self) -> int:
        """How many right-hand sides it takes."""
        return self.new + int(self.along.shape[1])

    @property
    def tolerances(self) -> list[float]:
        """The relative residual of each."""
        return [DISPLACEMENT] * self.new + [TANGENT] * self.along.shape[1]

    def alike(self, other: _Missing) -> bool:
        """Whether another one is of the same matrix."""
        same = self.basis.full_model.same_stiffness(other.basis.full_model)
        return same and np.array_equal(self.at.moduli, other.at.moduli)

    def loads(self, product: Product | None) -> NDArray[np.float64]:
        """Loads (n_free, number), mN, of what is sought: of the missing displacement, and of the derivatives.

        product: with the stiffness at the place, to have only what the derivatives that are there leave of theirs.
        """
        model, moduli, displacement = self.basis.full_model, self.at.moduli, self.displacement
        sought = -model.residual(moduli, displacement[:, None])[:, : self.new]
        if not self.along.shape[1]:
            return sought
        boundary = self.along[: len(moduli) + model.constraint.n_modes]
        loads = model.boundary_loads(moduli, self._whole(displacement), boundary) + self._material_loads(displacement)
        return np.concatenate([sought, loads if product is None else loads - product(self._within(loads))], axis=1)

    def further_loads(self, missing: NDArray[np.float64]) -> NDArray[np.float64]:
        """Loads (n_free, k), mN, of derivatives of what was `missing` (n_free, number) mm of the displacement.

        None where that is a small share.
        """
        model, n = self.basis.full_model, len(self.at.moduli)
        late = np.asarray(model.constraint.free @ missing[:, : self.new])
        if not self.along.shape[1] or np.linalg.norm(late) <= MISSING * np.linalg.norm(self.displacement):
            return missing[:, :0]
        boundary = self.along[: n + model.constraint.n_modes].copy()
        boundary[n:] = 0.0  # what boundary modes do does not depend on the displacement
        loads = model.boundary_loads(self.at.moduli, self._whole(late[:, 0]), boundary)
        return np.asarray(loads + self._material_loads(late[:, 0]))

    def _whole(self, displacement: NDArray[np.float64]) -> NDArray[np.float64]:
        """A displacement (n_dof,) mm of homogeneous tissues with what follows from the material at the place."""
        material = self.at.coefficients[self.basis.constraint.n_modes :, None]
        if not np.any(material):
            return displacement
        model = self.basis.full_model
        forces = model.material_forces(self.at.moduli, displacement, material)
        within = self._within(-np.asarray(model.constraint.free.T @ forces))
        return np.asarray(displacement + np.asarray(model.constraint.free @ within)[:, 0])

    def _material_loads(self, displacement: NDArray[np.float64]) -> NDArray[np.float64]:
        """Loads (n_free, k), mN, of derivatives by the material modes, and of these by ln E, at u (n_dof,) mm."""
        model, moduli = self.basis.full_model, self.at.moduli
        n, first, free = len(moduli), len(moduli) + model.constraint.n_modes, model.constraint.free
        if first == len(self.along):
            return np.zeros((free.shape[1], self.along.shape[1]))
        forces = model.material_forces(moduli, displacement, self.along[first:])
        material = self.at.coefficients[first - n :]
        if np.any(material) and np.any(self.along[:n]):  # forces of a region are as large as its modulus
            own = zip(model.material_by_region(displacement), moduli, strict=True)
            forces += np.concatenate([of.along(e * material[:, None]) for of, e in own], axis=1) @ self.along[:n]
        return -np.asarray(free.T @ forces)

    def _within(self, loads: NDArray[np.float64]) -> NDArray[np.float64]:
        """Responses (n_free, k) mm of the reduced model to loads (n_free, k) mN at the place."""
        projection = self.basis.projection
        return projection.spanned(projection.reduced.system(self.at.moduli).backward(projection.components(loads)))

    def corrected(self, near: LinearSystem, missing: NDArray[np.float64], cost: SolveCounts) -> ReducedBasis:
        """The basis with what was missing (n_free, number) mm, found with the factorisation of a system."""
        basis = self.basis
        sharper = replace(basis, system=near.of(basis.full_model))
        if not self.number:
            return replace(sharper, counts=sharper.counts + cost)
        material_at = self.at.moduli if self.every else basis.material_at
        found = _extended(replace(sharper, place=self.at, material_at=material_at), missing, cost)
        return found.at_place() if self.new and len(material_at) else found


def _corrected(found: Sequence[_Missing], near: LinearSystem) -> list[ReducedBasis]:
    """The bases of states of one body at the same moduli, with what they miss there, by the factorisation of `near`."""
    model, moduli = found[0].basis.full_model, found[0].at.moduli
    exact = np.array_equal(near.moduli, moduli)  # then one solution is all, and nothing known shortens it
    product = partial(model.free_forces, moduli)

    def solved(loads: Sequence[NDArray[np.float64]], tolerances: Sequence[float]) -> list[NDArray[np.float64]]:
        """Solutions (n_free, k) mm for the loads of each state."""
        rhs, ends = np.concatenate(loads, axis=1), np.cumsum([of.shape[1] for of in loads])[:-1]
        if not rhs.shape[1]:
            return list(loads)
        if exact:
            every = near.factorisation.solve(rhs, tolerance=SNAPSHOT)
        else:
            steps, nearly = MAX_ITERATIONS, near.factorisation.nearly
            every, _ = conjugate_gradients(product, rhs, nearly, tolerance=np.array(tolerances), max_iterations=steps)
        return np.split(every, ends, axis=1)

    loads = mapped(lambda of: of.loads(None if exact else product), found)
    missing = solved(loads, [tolerance for of in found for tolerance in of.tolerances])
    del loads
    further = mapped(lambda pair: pair[0].further_loads(pair[1]), zip(found, missing, strict=True))
    later = solved(further, [TANGENT] * sum(of.shape[1] for of in further))

    def corrected(of: tuple[_Missing, NDArray[np.float64], NDArray[np.float64]]) -> ReducedBasis:
        """One of the bases with what it missed, and what follows from that."""
        asked, own, more = of
        if more.shape[1]:
            own[:, asked.new :] += more
        cost = SolveCounts(forward=asked.new, tangent=asked.along.shape[1] + more.shape[1])
        return asked.corrected(near, own, cost)

    return mapped(corrected, zip(found, missing, later, strict=True))


def _near(found: Sequence[_Missing]) -> tuple[LinearSystem, bool]:
    """The system whose factorisation serves bases of one body at the same moduli, and whether it is made for them.

    A new one where the moduli are far from those of the one that is there, or where that costs less than the iterations
    it saves, and where the solver iterates, which is no preconditioner.
    """
    model, moduli = found[0].basis.full_model, found[0].at.moduli

    def spread(system: LinearSystem) -> float:
        """Condition number of the stiffness there with the factorised one."""
        ratios = moduli / system.moduli
        return float(ratios.max() / ratios.min())

    near = min((of.basis.system for of in found), key=spread)
    factorisation, number = near.factorisation, sum(of.number for of in found)
    if not number or np.array_equal(near.moduli, moduli):
        return near, False
    far = FAR if any(of.at.directions is not None for of in found) else FAR_ALONE
    if isinstance(factorisation, CheckedFactorisation) and SOLVERS[factorisation.solver].direct and spread(near) < far:
        solver = SOLVERS[factorisation.solver]
        unknowns = factorisation.matrix.shape[0]
        made, once = (solver.expect_of_size(unknowns, n).seconds for n in (0, max(number, FEW)))
        steps = ITERATIONS[0] + ITERATIONS[1] * (np.sqrt(spread(near)) - 1.0)
        if steps * (once - made) < made + MAKING * unknowns:
            return near, False
    return model.system(moduli), True


def reduced_basis(model: LinearModel, moduli: NDArray[np.float64]) -> ReducedBasis:
    """The model on its responses to every boundary mode at moduli (n_regions,) kPa; one factorisation."""
    system, free = model.system(moduli), sparse.csr_matrix(model.constraint.free.T)
    return basis_of(system, times(free, system.responses(tolerance=SNAPSHOT)), system.response_counts)


def basis_of(system: LinearSystem, snapshots: NDArray[np.float64], counts: SolveCounts) -> ReducedBasis:
    """A system's model on free displacements (n_free, k) mm, which are overwritten, with what these, and it, cost."""
    return ReducedBasis(projection(system.model, snapshots, overwrite=True), system, counts)


def _extended(basis: ReducedBasis, snapshots: NDArray[np.float64], cost: SolveCounts) -> ReducedBasis:
    return replace(basis, projection=basis.projection.extended(snapshots), counts=basis.counts + cost)
