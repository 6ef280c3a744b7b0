"""What a linear solver offers, and how one is described to the registry."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise
from typing import Protocol

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

ROOM, FEWEST = 2**27, 64  # bytes of right-hand sides that are solved for together, and their least number
EXACT = 1e-10  # default relative residual of a solution


def together(unknowns: int, number: int, *, room: int = ROOM, fewest: int = FEWEST) -> list[slice]:
    """Ranges, of nearly equal length, of so many right-hand sides that are met together, of numbers of eight bytes.

    They take up to `room` bytes, but for the `fewest` that are worth it; what a solution takes beside its answer is a
    multiple of that.
    """
    parts = -(-number // max(room // (8 * max(unknowns, 1)), fewest))
    return [slice(*ends) for ends in pairwise(np.linspace(0, number, parts + 1).astype(int).tolist())]


class Factorisation(Protocol):
    """A matrix A made ready to be solved with, again and again."""

    def solve(self, rhs: NDArray[np.float64], *, tolerance: float = EXACT) -> NDArray[np.float64]:
        """Solution X (n, m) of A X = rhs (n, m) to a relative residual of `tolerance`, or raises `SolverError`.

        What costs nothing more may be more exact than that.
        """
        ...

    def nearly(self, rhs: NDArray[np.float64]) -> NDArray[np.float64]:
        """A^-1 rhs (n, m) as exactly as is cheap: for iterations that it preconditions and that check themselves."""
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
    quadratic ones; right_hand_sides: how many solutions will be asked for, roughly.
    """

    near_nullspace: NDArray[np.float64] | None = None
    coarser: Coarser | None = None
    right_hand_sides: int = 100


@dataclass(frozen=True, slots=True)
class Expectation:
    """What factorising a matrix and solving for all right-hand sides will take on this machine: seconds and memory."""

    seconds: float
    bytes: float


Factoriser = Callable[[sparse.csr_matrix[np.float64], Hints], Factorisation]


@dataclass(frozen=True, slots=True)
class Solver:
    """A registered solver.

    factorise(matrix (n, n), hints) makes the factorisation and raises `SolverError`, or `ResourceError` for want of
    memory; expect(matrix, hints) says what that will take, expect_of_size(unknowns, right_hand_sides) what it will of
    quadratic tetrahedra; `direct`: whether it eliminates (its result is then probed
    for singularity).
    """

    name: str
    factorise: Factoriser
    direct: bool
    expect: Callable[[sparse.csr_matrix[np.float64], Hints], Expectation]
    expect_of_size: Callable[[int, int], Expectation]
