"""The registered solvers, the choice between them, and the check that each of their answers must pass."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from palpate.errors import ConfigurationError, SolverError
from palpate.mechanics.solvers import direct, multigrid
from palpate.mechanics.solvers.conjugate_gradients import column_norms, times
from palpate.mechanics.solvers.contract import EXACT, Coarser, Expectation, Factorisation, Hints
from palpate.processes import available_memory, total_memory

SOLVERS = {solver.name: solver for solver in (direct.SOLVER, direct.MIXED, multigrid.SOLVER)}
SINGLE = 1e-5  # relative residual that a factor in single precision reaches
TOLERANCE = 1e-8  # relative residual that rounding may leave
LARGEST_CONDITION = 1e13  # condition number beyond which a direct solution has lost most of its digits
USABLE = 0.8  # of the free memory; the rest is for the solutions
SHARE = 0.5  # of the machine's memory, so that other programs do not change the choice unless memory is short


@dataclass(frozen=True, slots=True)
class CheckedFactorisation:
    """A factorisation whose every solution is refined once if need be, and refused when its residual is too large."""

    matrix: sparse.csr_matrix[np.float64]
    inner: Factorisation
    solver: str

    def solve(self, rhs: NDArray[np.float64], *, tolerance: float = EXACT) -> NDArray[np.float64]:
        """Solution X (n, m) of A X = rhs (n, m); raises `SolverError` where its relative residual is too large.

        That is above ten times the `tolerance`, and above 1e-8. Where single precision suffices, one product with the
        matrix checks all columns: of their sum with random signs (Freivalds, MFCS 1979).
        """
        limit = max(TOLERANCE, 10.0 * tolerance)
        if not np.all(np.isfinite(rhs)):
            raise SolverError("a load of the linear system is not finite: check moduli and prescribed displacements")
        if tolerance >= SINGLE and SOLVERS[self.solver].direct:
            solution = self.inner.nearly(rhs)
            norms = column_norms(rhs)
            signs = np.random.default_rng(0).choice([-1.0, 1.0], rhs.shape[1]) / np.where(norms > 0.0, norms, 1.0)
            left = float(np.linalg.norm(rhs @ signs - times(self.matrix, (solution @ signs)[:, None])[:, 0]))
            if left <= tolerance * np.sqrt(rhs.shape[1]):
                return solution
        solution = self.inner.solve(rhs, tolerance=tolerance)
        share, residual = self._residual(rhs, solution)
        if share > limit:
            solution = solution + self.inner.solve(residual, tolerance=tolerance)
            share, _ = self._residual(rhs, solution)
        if share > limit:
            raise SolverError(
                f"solver '{self.solver}' left a relative residual of {share:.2g} (limit {limit:g}) in"
                f" {len(rhs)} unknowns: the moduli may differ too much, Poisson's ratio may be too close to 0.5, or"
                " tetrahedra may be too flat; try another solver or a better mesh"
            )
        return solution

    def nearly(self, rhs: NDArray[np.float64]) -> NDArray[np.float64]:
        """A^-1 rhs (n, m), unchecked: for iterations that it preconditions."""
        return self.inner.nearly(rhs)

    def _residual(self, rhs: NDArray[np.float64], solution: NDArray[np.float64]) -> tuple[float, NDArray[np.float64]]:
        residual = rhs - times(self.matrix, solution)
        norms = column_norms(rhs)
        shares = column_norms(residual) / np.where(norms > 0.0, norms, 1.0)
        largest = float(np.max(shares, initial=0.0))
        return (largest if np.isfinite(largest) else np.inf), residual


def factorise(
    matrix: sparse.csr_matrix[np.float64],
    *,
    solver: str = "auto",
    near_nullspace: NDArray[np.float64] | None = None,
    coarser: Coarser | None = None,
    right_hand_sides: int = 100,
) -> Factorisation:
    """Make the symmetric positive definite `matrix` (n, n), mN/mm, ready to be solved with.

    solver: a name of `SOLVERS`, or "auto": the one that is expected to take the least time for the factorisation and
    for `right_hand_sides`, among those that need no more than half of the machine's memory and find it free.
    near_nullspace (n, k), mm: displacements of little energy (the rigid motions), which multigrid needs to converge
    fast; coarser: the linear displacements among quadratic ones, which halve its iterations. Raises `SolverError` for a
    singular or indefinite matrix, `ConfigurationError` for an unknown name, `ResourceError` where memory does not
    suffice.
    """
    if solver != "auto" and solver not in SOLVERS:
        raise ConfigurationError(f"solver is '{solver}'; it must be 'auto' or one of {sorted(SOLVERS)}")
    if matrix.shape[0] == 0:
        raise SolverError("no displacement is free: every point of the mesh is prescribed, nothing is left to solve")
    if not np.all(np.isfinite(matrix.data)):
        raise SolverError("the stiffness is not finite: check the moduli and the mesh's volumes")
    hints = Hints(near_nullspace, coarser, right_hand_sides)
    if solver == "auto":
        free = available_memory()
        room = min(_room(), np.inf if free is None else USABLE * free)
        solver = _fastest({name: known.expect(matrix, hints) for name, known in SOLVERS.items()}, room)
    chosen = SOLVERS[solver]
    checked = CheckedFactorisation(matrix, chosen.factorise(matrix, hints), chosen.name)
    if chosen.direct:
        # probe the condition: |A| |x| / |b| for a random b is a lower estimate; a floating body makes it 1e16
        n = matrix.shape[0]
        probe = np.random.default_rng(0).standard_normal((n, 1))
        response = checked.inner.nearly(probe)
        size = float(np.max(abs(matrix).sum(axis=1)))
        condition = size * float(np.linalg.norm(response) / np.linalg.norm(probe))
        if not condition < LARGEST_CONDITION:
            raise SolverError(
                f"the stiffness of {n} unknowns is singular (condition number at least {condition:.1g}): some part of"
                " the body can move without resistance; hold it (outer boundary 'fixed', a rigid or driver tissue) or"
                " join it to its neighbours"
            )
    return checked


def expected_of_size(unknowns: int, right_hand_sides: int, *, solver: str = "auto") -> tuple[str, Expectation]:
    """The solver that quadratic tetrahedra of so many unknowns will have on this machine, and what it will take.

    It does not depend on what else runs: `factorise` takes another only where the memory for this one is not free.
    """
    expected = {name: known.expect_of_size(unknowns, right_hand_sides) for name, known in SOLVERS.items()}
    chosen = _fastest(expected, _room()) if solver == "auto" else solver
    return chosen, expected[chosen]


def _room() -> float:
    """Bytes that a factorisation may take on this machine."""
    total = total_memory()
    return np.inf if total is None else SHARE * total


def _fastest(expected: dict[str, Expectation], room: float) -> str:
    """The solver of least expected time that needs no more than `room` bytes; else the one that takes least."""
    fitting = [name for name in expected if expected[name].bytes <= room]
    if not fitting:
        return min(expected, key=lambda name: expected[name].bytes)
    return min(fitting, key=lambda name: expected[name].seconds)
