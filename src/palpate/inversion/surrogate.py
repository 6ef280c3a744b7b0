"""A reduced model that is exact where it matters: built at one place, enriched where the optimiser goes."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from palpate.mechanics.forward import SolveCounts
from palpate.mechanics.linear_model import LinearModel, LinearSystem
from palpate.mechanics.reduced import ReducedModel, reduce
from palpate.mechanics.solvers.contract import Factorisation
from palpate.mesh.constraint import Constraint

__all__ = ["Surrogate", "enriched", "first_surrogate", "with_modulus_series", "with_offset"]

SERIES = 40  # vectors at the most


@dataclass(frozen=True, slots=True)
class Surrogate:
    """`reduced` spans the snapshots (n_free, k) of `model`; `system` is the last factorised one; `counts` the cost."""

    model: LinearModel
    snapshots: NDArray[np.float64]
    reduced: ReducedModel
    system: LinearSystem
    counts: SolveCounts

    @property
    def constraint(self) -> Constraint:
        """What is prescribed to the model."""
        return self.model.constraint

    @property
    def factorisation(self) -> Factorisation:
        """That of the system that was factorised first."""
        return self.system.factorisation

    def relative_error(self, moduli: NDArray[np.float64], coefficients: NDArray[np.float64]) -> float:
        """Upper bound of the reduced displacement's relative error in energy at moduli (kPa) and coefficients."""
        displacement = self.reduced.solve(moduli, coefficients).values
        return float(self.system.error_bound(moduli, displacement[:, None])[0])


def first_surrogate(model: LinearModel, moduli: NDArray[np.float64]) -> Surrogate:
    """Responses to every boundary mode at moduli (n_regions,) kPa."""
    system = model.system(moduli)
    snapshots = np.asarray(model.constraint.free.T @ system.responses())
    return Surrogate(model, snapshots, reduce(model, snapshots), system, system.response_counts)


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
    fresh = np.asarray(model.constraint.free.T @ np.concatenate(vectors, axis=1))
    snapshots = np.concatenate([surrogate.snapshots, fresh], axis=1)
    counts = surrogate.counts + SolveCounts(tangent=fresh.shape[1])
    return Surrogate(model, snapshots, reduce(model, snapshots), system, counts)


def enriched(surrogate: Surrogate, moduli: NDArray[np.float64], coefficients: NDArray[np.float64]) -> Surrogate:
    """Add the responses at moduli (n_regions,) kPa and the modulus derivatives of the displacement there."""
    model = surrogate.model
    system = model.system(moduli)
    responses = system.responses()
    solution = responses @ np.append(coefficients, 1.0)
    derivatives = system.modulus_responses(solution[:, None])[:, :, 0].T
    free = model.constraint.free
    fresh = np.concatenate([free.T @ responses, free.T @ derivatives], axis=1)
    snapshots = np.concatenate([surrogate.snapshots, fresh], axis=1)
    counts = surrogate.counts + system.response_counts + SolveCounts(tangent=model.n_regions)
    return Surrogate(model, snapshots, reduce(model, snapshots), system, counts)


def with_offset(surrogate: Surrogate, model: LinearModel) -> Surrogate:
    """The same snapshots for a `model` that differs in the offset of its constraint, and the response to it added."""
    system = replace(surrogate.system, model=model)
    fresh = np.asarray(model.constraint.free.T @ system.solve(np.zeros(model.n_modes)).values)[:, None]
    snapshots = np.concatenate([surrogate.snapshots, fresh], axis=1)
    counts = surrogate.counts + SolveCounts(forward=1)
    return Surrogate(model, snapshots, reduce(model, snapshots), system, counts)
