"""Intel MKL PARDISO: the fastest direct solver on x86, an optional extra.

Schenk & Gaertner, Future Generation Computer Systems 20 (2004) 475-487.
"""

from __future__ import annotations

import functools
import importlib
import importlib.metadata
import os
import weakref
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from palpate.errors import SolverError
from palpate.mechanics.solvers.contract import Factorisation, Hints, Solver
from palpate.mechanics.solvers.pattern import nested_dissection

__all__ = ["SOLVER"]

SYMMETRIC_POSITIVE_DEFINITE = 2  # PARDISO's `mtype`
# PARDISO's `iparm`, by the numbers of its manual: 1 values of ours, 5 an order of ours, 8 no refinement (by default
# each solution is refined twice, at three times its price, from a residual of 1e-14 to 5e-15).
PARAMETERS = {1: 1, 5: 1, 8: 0}


class PardisoFactorisation:
    """Cholesky factors in PARDISO's own memory, given back when this object is dropped."""

    __slots__ = ("__weakref__", "_solver", "_upper")

    def __init__(self, matrix: sparse.csr_matrix[np.float64]) -> None:
        pypardiso = importlib.import_module("pypardiso")
        _tell_where_mkl_is()
        self._upper = sparse.csr_matrix(sparse.triu(matrix, format="csr"))
        self._upper.sort_indices()
        self._solver = pypardiso.PyPardisoSolver(mtype=SYMMETRIC_POSITIVE_DEFINITE, size_limit_storage=np.inf)
        for number, value in PARAMETERS.items():
            self._solver.set_iparm(number, value)
        self._solver.perm = (nested_dissection(matrix) + 1).astype(np.int32)
        try:
            self._solver.factorize(self._upper)
        except (ValueError, pypardiso.pardiso_wrapper.PyPardisoError) as error:
            self._solver.free_memory(everything=True)
            raise SolverError(
                f"PARDISO could not factorise {matrix.shape[0]} unknowns ({error}); code -4 means that the stiffness"
                " is not positive definite: hold the body somewhere and check for inverted tetrahedra;"
                " code -2 means that memory ran out: use a coarser mesh or solver 'multigrid'"
            ) from error
        self._solver.factorized_A = self._upper  # the wrapper would keep a copy to compare with
        weakref.finalize(self, self._solver.free_memory, everything=True)

    def solve(self, rhs: NDArray[np.float64]) -> NDArray[np.float64]:
        """Solution X (n, m) of A X = rhs (n, m), all columns at once."""
        return np.asarray(self._solver.solve(self._upper, np.asfortranarray(rhs)))


@functools.cache
def _tell_where_mkl_is() -> None:
    """Set pypardiso's own variable, once: without it every factorisation searches the whole environment for MKL."""
    try:
        files = importlib.metadata.files("mkl") or []
    except importlib.metadata.PackageNotFoundError:
        return
    found = [Path(str(file.locate())).resolve() for file in files if "mkl_rt" in file.name]
    existing = [str(path) for path in found if path.exists()]
    if existing:
        os.environ.setdefault("PYPARDISO_MKL_RT", min(existing, key=len))


def _available() -> bool:
    try:
        importlib.import_module("pypardiso")
    except (ImportError, OSError):  # the package, or MKL itself
        return False
    return True


def _factorise(matrix: sparse.csr_matrix[np.float64], hints: Hints) -> Factorisation:
    del hints  # elimination has no use for it
    return PardisoFactorisation(matrix)


SOLVER = Solver("pardiso", _factorise, True, _available, "install it with: pip install 'palpate[pardiso]'")
