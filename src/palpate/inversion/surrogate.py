"""A reduced model that is exact where it matters: built at one place, enriched where the optimiser goes."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from palpate.mechanics.forward import SolveCounts
from palpate.mechanics.linear_model import LinearModel, LinearSystem
from palpate.mechanics.reduced import ReducedModel, reduce

__all__ = ["Surrogate", "enriched", "first_surrogate"]


@dataclass(frozen=True, slots=True)
class Surrogate:
    """`reduced` spans the snapshots (n_free, k) of `model`; `system` is the last factorised one; `counts` the cost."""

    model: LinearModel
    snapshots: NDArray[np.float64]
    reduced: ReducedModel
    system: LinearSystem
    counts: SolveCounts

    def relative_error(self, moduli: NDArray[np.float64], coefficients: NDArray[np.float64]) -> float:
        """Upper bound of the reduced displacement's relative error in energy at moduli (kPa) and coefficients."""
        displacement = self.reduced.solve(moduli, coefficients).values
        return float(self.system.error_bound(moduli, displacement[:, None])[0])


def first_surrogate(model: LinearModel, moduli: NDArray[np.float64], columns: NDArray[np.int64]) -> Surrogate:
    """Responses to every boundary mode at moduli (n_regions,) kPa, and their derivatives by ln E of `columns`."""
    system = model.system(moduli)
    responses = system.responses()
    derivatives = system.modulus_responses(responses, regions=columns)
    free = model.constraint.free
    snapshots = np.concatenate([free.T @ part for part in (responses, *derivatives)], axis=1)
    counts = system.response_counts + SolveCounts(tangent=responses.shape[1] * len(columns))
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
