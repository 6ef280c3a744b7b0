"""The four verbs of a forward model: solve, and of its equilibrium displacement, tangent and adjoint."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import astuple, dataclass
from operator import add, sub
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from palpate.errors import ConfigurationError

Outputs = Callable[[NDArray[np.float64]], NDArray[np.float64]]
"""A linear map of displacements (n_dof, ...) to a model's outputs (n_outputs, ...): what is seen of them."""


@dataclass(frozen=True, slots=True)
class SolveCounts:
    """How much was solved: right-hand sides forward, adjoint and for tangents, and factorisations."""

    forward: int = 0
    adjoint: int = 0
    tangent: int = 0
    factorisations: int = 0

    def __add__(self, other: SolveCounts) -> SolveCounts:
        return SolveCounts(*map(add, astuple(self), astuple(other)))

    def __sub__(self, other: SolveCounts) -> SolveCounts:
        return SolveCounts(*map(sub, astuple(self), astuple(other)))


class Equilibrium(Protocol):
    """A displacement u(E, q) in equilibrium, with its derivatives at that place.

    E (n_regions,) kPa are the Young's moduli, q (n_modes,) the coefficients of the boundary modes.
    """

    @property
    def values(self) -> NDArray[np.float64]:
        """Displacement u (n_outputs,) mm; of a model that gives all points, number 3 p + i is point p along axis i."""
        ...

    @property
    def displacement(self) -> NDArray[np.float64]:
        """Displacement u (n_outputs / 3, 3) mm, one row a point."""
        ...

    @property
    def counts(self) -> SolveCounts:
        """What the way to this equilibrium cost."""
        ...

    @property
    def tangent_counts(self) -> SolveCounts:
        """What one call of `tangent` costs."""
        ...

    def tangent(self) -> NDArray[np.float64]:
        """T (n_outputs, n_regions + n_modes), mm: columns du / d ln E_r, then du / dq_k."""
        ...

    def adjoint(self, gradient: NDArray[np.float64]) -> NDArray[np.float64]:
        """T^T g (n_regions + n_modes,) for a gradient g (n_outputs,) with respect to u, by one adjoint solve."""
        ...


class ForwardModel(Protocol):
    """From moduli and boundary modes to a displacement: K(E) u = 0 on what is free, K(E) = sum_r E_r K_r if linear."""

    @property
    def n_regions(self) -> int:
        """Number of moduli."""
        ...

    @property
    def n_modes(self) -> int:
        """Number of coefficients of boundary modes."""
        ...

    def solve(self, moduli: NDArray[np.float64], coefficients: NDArray[np.float64]) -> Equilibrium:
        """Equilibrium at moduli (n_regions,) kPa and coefficients (n_modes,); raises `SolverError`."""
        ...


def checked_moduli(moduli: ArrayLike, names: Sequence[str]) -> NDArray[np.float64]:
    """Moduli (n_regions,) kPa of the tissues `names`; raises `ConfigurationError` unless all are positive numbers."""
    values = np.array(moduli, dtype=float)
    if values.shape != (len(names),):
        raise ConfigurationError(
            f"Young's moduli have the shape {values.shape}; give one each for the {len(names)} tissues {list(names)}"
        )
    wrong = ~(np.isfinite(values) & (values > 0.0))
    if wrong.any():
        first = int(np.flatnonzero(wrong)[0])
        raise ConfigurationError(
            f"the Young's modulus of tissue '{names[first]}' is {values[first]} kPa; give a positive number"
        )
    values.setflags(write=False)
    return values


def checked_coefficients(coefficients: ArrayLike, n_modes: int) -> NDArray[np.float64]:
    """Mode coefficients (n_modes,), dimensionless; raises `ConfigurationError` unless they are finite and as many."""
    values = np.array(coefficients, dtype=float)
    if values.shape != (n_modes,) or not np.all(np.isfinite(values)):
        raise ConfigurationError(
            f"mode coefficients have the shape {values.shape}; give {n_modes} finite numbers, one for each boundary"
            " mode"
        )
    values.setflags(write=False)
    return values


class DenseEquilibrium:
    """The part of `Equilibrium` that follows from the outputs `values` (n_outputs,) mm alone."""

    __slots__ = ()
    values: NDArray[np.float64]

    @property
    def displacement(self) -> NDArray[np.float64]:
        """Displacement u (n_outputs / 3, 3) mm; raises `ConfigurationError` when the outputs are not whole points."""
        if len(self.values) % 3:
            raise ConfigurationError(
                f"the model has {len(self.values)} outputs, not three for each point: use `values`"
            )
        return self.values.reshape(-1, 3)

    @property
    def counts(self) -> SolveCounts:
        """Nothing of the size of the mesh was solved."""
        return SolveCounts()

    @property
    def tangent_counts(self) -> SolveCounts:
        """Nothing of the size of the mesh is solved."""
        return SolveCounts()
