"""A reduced model that is exact where it matters: built at one place, extended where the optimiser goes."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from palpate.mechanics.forward import SolveCounts
from palpate.mechanics.linear_model import LinearModel, LinearSystem, weighted_sum
from palpate.mechanics.reduced import Projection, ReducedModel, projection
from palpate.mechanics.solvers.conjugate_gradients import conjugate_gradients
from palpate.mechanics.solvers.contract import Factorisation
from palpate.mechanics.solvers.registry import SOLVERS, CheckedFactorisation
from palpate.mesh.constraint import Constraint

__all__ = ["Surrogate", "enriched", "first_surrogate", "sharpened", "with_modulus_series", "with_offset"]

SERIES = 40  # vectors at the most
FAR = 30.0  # spread of the moduli's ratios to the factorised ones, beyond which a new factorisation costs less
DISPLACEMENT, TANGENT = 1e-4, 1e-2  # of the reduced model's error, that a correction may leave
MAX_ITERATIONS = 60


@dataclass(frozen=True, slots=True)
class Surrogate:
    """A model projected on m vectors (n_free, m); `system`: the last factorised one; `counts`: what it cost."""

    projection: Projection
    system: LinearSystem
    counts: SolveCounts

    @property
    def model(self) -> LinearModel:
        """The full model."""
        return self.projection.model

    @property
    def reduced(self) -> ReducedModel:
        """The reduced model."""
        return self.projection.reduced

    @property
    def constraint(self) -> Constraint:
        """What is prescribed to the model."""
        return self.model.constraint

    @property
    def factorisation(self) -> Factorisation:
        """That of the system that was factorised last."""
        return self.system.factorisation

    def relative_error(self, moduli: NDArray[np.float64], coefficients: NDArray[np.float64]) -> float:
        """Upper bound of the displacement's relative error in energy at moduli (n_regions,) kPa, amounts (n_modes,)."""
        displacement = self.reduced.solve(moduli, coefficients).values
        return float(self.system.error_bound(moduli, displacement[:, None])[0])


def first_surrogate(model: LinearModel, moduli: NDArray[np.float64]) -> Surrogate:
    """Responses to every boundary mode at moduli (n_regions,) kPa."""
    system = model.system(moduli)
    snapshots = np.asarray(model.constraint.free.T @ system.responses())
    return Surrogate(projection(model, snapshots), system, system.response_counts)


def with_modulus_series(
    surrogate: Surrogate, coefficients: NDArray[np.float64], columns: NDArray[np.int64]
) -> Surrogate:
    """Add how the displacement at `coefficients` (n_modes,) changes with ln E of the regions `columns`, to high order.

    The repeated derivatives w -> K^-1 (-E_r K_r w) of all orders up to a number span the dependence on the moduli over
    a wide range, for K is affine in them (moment matching; Grimme 1997). One right-hand side each, no factorisation.
    """
    model, system = surrogate.model, surrogate.system
    level = surrogate.reduced.solve(system.moduli, coefficients).values[:, None]
    vectors: list[NDArray[np.float64]] = []
    while level.shape[1] * len(columns) + sum(v.shape[1] for v in vectors) <= SERIES:
        level = np.concatenate(list(system.modulus_responses(level, regions=columns)), axis=1)
        vectors.append(level)
    if not vectors:
        return surrogate
    fresh = np.asarray(model.constraint.free.T @ np.concatenate(vectors, axis=1))
    return _extended(surrogate, fresh, SolveCounts(tangent=fresh.shape[1]))


def sharpened(
    surrogate: Surrogate,
    moduli: NDArray[np.float64],
    coefficients: NDArray[np.float64],
    directions: NDArray[np.float64],
) -> Surrogate:
    """Add what the reduced model misses at moduli (n_regions,) kPa: of the displacement there, and of its derivatives.

    The derivatives are those along `directions` (n_regions + n_modes, k) of (ln E, q). Both are corrections by
    conjugate gradients with the factorisation that is there, from the reduced answers on; where it is none, or the
    moduli are far from its own, with a new one.
    """
    model, near = surrogate.model, _near(surrogate, moduli)
    displacement = surrogate.reduced.solve(moduli, coefficients).values
    missing = -near.solve(model.residual(moduli, displacement[:, None]), DISPLACEMENT)
    sharper = _extended(replace(surrogate, system=near.system), missing, near.counts + SolveCounts(forward=1))
    values = displacement + np.asarray(model.constraint.free @ missing)[:, 0]
    loads = _loads_along(directions, model, moduli, values)
    vectors = sharper.projection.vectors
    known = vectors @ sharper.reduced.system(moduli).backward(vectors.T @ loads)
    rest = near.solve(loads - near.matrix @ known, TANGENT)
    return _extended(sharper, rest, SolveCounts(tangent=rest.shape[1]))


def enriched(surrogate: Surrogate, moduli: NDArray[np.float64], coefficients: NDArray[np.float64]) -> Surrogate:
    """Add all responses at moduli (n_regions,) kPa and the modulus derivatives of the displacement there.

    A factorisation and a right-hand side a mode: `sharpened` costs a fraction, but serves the given place only.
    """
    model = surrogate.model
    system = model.system(moduli)
    responses = system.responses()
    solution = responses @ np.append(coefficients, 1.0)
    derivatives = system.modulus_responses(solution[:, None])[:, :, 0].T
    free = model.constraint.free
    fresh = np.concatenate([free.T @ responses, free.T @ derivatives], axis=1)
    cost = system.response_counts + SolveCounts(tangent=model.n_regions)
    return _extended(replace(surrogate, system=system), fresh, cost)


def with_offset(surrogate: Surrogate, model: LinearModel) -> Surrogate:
    """The same vectors for a `model` that differs in the offset of its constraint, and the response to it added."""
    system = replace(surrogate.system, model=model)
    fresh = np.asarray(model.constraint.free.T @ system.solve(np.zeros(model.n_modes)).values)[:, None]
    moved = replace(surrogate, projection=surrogate.projection.under(model), system=system)
    return _extended(moved, fresh, SolveCounts(forward=1))


def _extended(surrogate: Surrogate, snapshots: NDArray[np.float64], cost: SolveCounts) -> Surrogate:
    extended = surrogate.projection.extended(snapshots)
    return replace(surrogate, projection=extended, counts=surrogate.counts + cost)


def _loads_along(
    directions: NDArray[np.float64], model: LinearModel, moduli: NDArray[np.float64], values: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Loads (n_free, k), mN, whose responses are the free part of the derivatives of u (n_dof,) along directions."""
    by_modulus, by_mode = directions[: model.n_regions], directions[model.n_regions :]
    loads = -np.asarray(weighted_sum(moduli, model.coupling)[:, :-1] @ by_mode)
    for modulus, matrix, share in zip(moduli, model.stiffness, by_modulus, strict=True):
        loads -= np.outer(model.constraint.free.T @ (modulus * (matrix @ values)), share)
    return loads


@dataclass(frozen=True, slots=True)
class _Near:
    """The stiffness `matrix` (n_free, n_free), mN/mm, at some moduli; `system`: that of the factors at hand."""

    matrix: sparse.csr_matrix[np.float64]
    system: LinearSystem
    counts: SolveCounts

    def solve(self, rhs: NDArray[np.float64], tolerance: float) -> NDArray[np.float64]:
        """Solution (n_free, k) mm to a relative residual; raises `SolverError`."""
        solution, _ = conjugate_gradients(
            self.matrix, rhs, self.system.factorisation.nearly, tolerance=tolerance, max_iterations=MAX_ITERATIONS
        )
        return solution


def _near(surrogate: Surrogate, moduli: NDArray[np.float64]) -> _Near:
    """The stiffness at moduli (n_regions,) kPa with the factors at hand, or with its own where those are no help."""
    system = surrogate.system
    ratios = moduli / system.moduli
    if ratios.max() < FAR * ratios.min() and _direct(system.factorisation):
        return _Near(weighted_sum(moduli, surrogate.model.free_stiffness), system, SolveCounts())
    fresh = surrogate.model.system(moduli)
    matrix = weighted_sum(moduli, surrogate.model.free_stiffness)
    return _Near(matrix, fresh, SolveCounts(factorisations=1))


def _direct(factorisation: Factorisation) -> bool:
    """Whether a solution costs little beside the factorisation: not where it iterates itself."""
    return isinstance(factorisation, CheckedFactorisation) and SOLVERS[factorisation.solver].direct
