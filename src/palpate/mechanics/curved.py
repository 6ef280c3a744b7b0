"""A model to first order around an equilibrium, with the curvature of a like model whose answers are cheap."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Self

import numpy as np
from numpy.typing import NDArray

from palpate.mechanics.first_order import FirstOrderModel, expanded
from palpate.mechanics.forward import DenseEquilibrium, Equilibrium, ForwardModel


@dataclass(frozen=True, slots=True)
class CurvedModel:
    """u(E, q) = u_1(E, q) + w(E, q) - w_1(E, q); implements `ForwardModel`.

    u_1: `expansion`; w: the `like` model, of the same outputs; w_1: its expansion at the same place (`linear`). There
    value and first derivatives are those of u_1. The second ones are those of w: that an organ matters the less the
    stiffer it is, both laws have in common.
    """

    expansion: FirstOrderModel
    like: ForwardModel
    linear: FirstOrderModel

    @classmethod
    def of(cls, expansion: FirstOrderModel, like: ForwardModel) -> Self:
        """The expansion bent as the `like` model is."""
        names, moduli, coefficients = expansion.names, expansion.moduli, expansion.coefficients
        there = like.solve(moduli, coefficients)
        return cls(expansion, like, expanded(there, names=names, moduli=moduli, coefficients=coefficients))

    @property
    def n_regions(self) -> int:
        """Number of moduli."""
        return self.expansion.n_regions

    @property
    def n_modes(self) -> int:
        """Number of boundary modes."""
        return self.expansion.n_modes

    def solve(self, moduli: NDArray[np.float64], coefficients: NDArray[np.float64]) -> CurvedEquilibrium:
        """The displacement at moduli (n_regions,) kPa and mode coefficients (n_modes,); raises `SolverError`."""
        bent = self.like.solve(moduli, coefficients)
        first, linear = self.expansion.solve(moduli, coefficients), self.linear.solve(moduli, coefficients)
        return CurvedEquilibrium(self, bent, first.values + bent.values - linear.values)


@dataclass(frozen=True, slots=True)
class CurvedEquilibrium(DenseEquilibrium):
    """Outputs (n_outputs,) mm at one place, with the like model's equilibrium `bent`; implements `Equilibrium`."""

    model: CurvedModel
    bent: Equilibrium
    values: NDArray[np.float64]

    def tangent(self) -> NDArray[np.float64]:
        """T (n_outputs, n_regions + n_modes), mm: columns du / d ln E_r, then du / dq_k."""
        return np.asarray(self.bent.tangent() + (self.model.expansion.derivatives - self.model.linear.derivatives))

    def adjoint(self, gradient: NDArray[np.float64]) -> NDArray[np.float64]:
        """T^T g (n_regions + n_modes,) for g (n_outputs,)."""
        rest = self.model.expansion.derivatives - self.model.linear.derivatives
        return np.asarray(self.bent.adjoint(gradient) + rest.T @ gradient)
