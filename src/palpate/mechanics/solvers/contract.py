"""What a linear solver offers, and how one is described to the registry."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

__all__ = ["Factorisation", "Factoriser", "Solver", "always"]


class Factorisation(Protocol):
    """A matrix A made ready to be solved with, again and again."""

    def solve(self, rhs: NDArray[np.float64]) -> NDArray[np.float64]:
        """Solution X (n, m) of A X = rhs (n, m); raises `SolverError` when it misses its tolerance."""
        ...


Factoriser = Callable[[sparse.csr_matrix[np.float64], NDArray[np.float64] | None], Factorisation]


@dataclass(frozen=True, slots=True)
class Solver:
    """A registered solver.

    factorise(matrix (n, n), near_nullspace (n, k) or None) makes the factorisation and raises `SolverError`;
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
