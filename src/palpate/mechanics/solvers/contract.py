"""What a linear solver offers, and how one is described to the registry."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

__all__ = ["Coarser", "Factorisation", "Factoriser", "Hints", "Solver", "always"]


class Factorisation(Protocol):
    """A matrix A made ready to be solved with, again and again."""

    def solve(self, rhs: NDArray[np.float64]) -> NDArray[np.float64]:
        """Solution X (n, m) of A X = rhs (n, m); raises `SolverError` when it misses its tolerance."""
        ...


@dataclass(frozen=True, slots=True)
class Coarser:
    """A smaller space inside that of the unknowns: `prolongation` (n, n_coarse), dimensionless, from it.

    kept (n_coarse,): the unknowns that it keeps; the prolongation's rows there are those of the identity.
    """

    prolongation: sparse.csr_matrix[np.float64]
    kept: NDArray[np.int64]


@dataclass(frozen=True, slots=True)
class Hints:
    """What is known of a matrix beside its entries, for solvers that can use it.

    near_nullspace (n, k), mm: displacements of little energy (the rigid motions); coarser: linear displacements among
    quadratic ones.
    """

    near_nullspace: NDArray[np.float64] | None = None
    coarser: Coarser | None = None


Factoriser = Callable[[sparse.csr_matrix[np.float64], Hints], Factorisation]


@dataclass(frozen=True, slots=True)
class Solver:
    """A registered solver.

    factorise(matrix (n, n), hints) makes the factorisation and raises `SolverError`;
    `direct`: whether it eliminates (its result is then probed for singularity);
    `available()`: whether its library is installed; `missing`: what to do when it is not.
    """

    name: str
    factorise: Factoriser
    direct: bool
    available: Callable[[], bool]
    missing: str = ""


def always() -> bool:
    """Whether a solver that needs nothing beyond the core installation is available: it is."""
    return True
