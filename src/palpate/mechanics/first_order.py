"""A model to first order around one of its equilibria: all that a step of an iteration needs."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from palpate.mechanics.forward import DenseEquilibrium, Equilibrium, Outputs, checked_coefficients, checked_moduli


@dataclass(frozen=True, slots=True)
class FirstOrderModel:
    """u(E, q) = u_0 + T [ln E - ln E_0, q - q_0]; implements `ForwardModel`.

    E_0 `moduli` (n_regions,) kPa of the tissues `names`, q_0 `coefficients` (n_modes,), u_0 `values` (n_outputs,) mm,
    T `derivatives` (n_outputs, n_regions + n_modes) mm.
    """

    names: tuple[str, ...]
    moduli: NDArray[np.float64]
    coefficients: NDArray[np.float64]
    values: NDArray[np.float64]
    derivatives: NDArray[np.float64]

    @property
    def n_regions(self) -> int:
        """Number of moduli."""
        return len(self.moduli)

    @property
    def n_modes(self) -> int:
        """Number of boundary modes."""
        return len(self.coefficients)

    def outputs(self, seen: Outputs) -> FirstOrderModel:
        """The same model with the outputs that a linear map makes of the present ones."""
        return replace(self, values=seen(self.values), derivatives=seen(self.derivatives))

    def solve(self, moduli: NDArray[np.float64], coefficients: NDArray[np.float64]) -> FirstOrderEquilibrium:
        """The expansion at moduli (n_regions,) kPa and mode coefficients (n_modes,)."""
        change = np.log(checked_moduli(moduli, self.names) / self.moduli)
        amounts = checked_coefficients(coefficients, self.n_modes) - self.coefficients
        values = self.values + self.derivatives @ np.concatenate([change, amounts])
        values.setflags(write=False)
        return FirstOrderEquilibrium(self, values)


@dataclass(frozen=True, slots=True)
class FirstOrderEquilibrium(DenseEquilibrium):
    """The expansion's displacement `values` (n_outputs,) mm at one place; implements `Equilibrium`."""

    model: FirstOrderModel
    values: NDArray[np.float64]

    def tangent(self) -> NDArray[np.float64]:
        """T (n_outputs, n_regions + n_modes), mm: columns du / d ln E_r, then du / dq_k."""
        return self.model.derivatives.copy()

    def adjoint(self, gradient: NDArray[np.float64]) -> NDArray[np.float64]:
        """T^T g (n_regions + n_modes,) for g (n_outputs,)."""
        return np.asarray(self.model.derivatives.T @ gradient)


def expanded(
    equilibrium: Equilibrium, *, names: tuple[str, ...], moduli: NDArray[np.float64], coefficients: NDArray[np.float64]
) -> FirstOrderModel:
    """The expansion around an equilibrium at moduli (n_regions,) kPa and coefficients (n_modes,); one tangent."""
    return FirstOrderModel(names, moduli, coefficients, equilibrium.values, equilibrium.tangent())
