"""A finite-strain model to first order around one of its equilibria.

Where the estimate goes the expansion moves with it: the equilibrium is solved anew, its derivatives stay as long as
they serve. One factorisation, made near the first equilibrium, gives all derivatives there and serves every solve. Near
the estimate the derivatives along the directions that decide the moduli, which is all that these need to first order,
are made those of the equilibrium there.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from palpate.approximation.contract import Approximation, LinearisationPoint, ModelError, determined
from palpate.errors import NotConverged, SolverError
from palpate.mechanics.equilibrium import from_start
from palpate.mechanics.finite_strain import FiniteStrainEquilibrium, FiniteStrainModel
from palpate.mechanics.first_order import FirstOrderModel
from palpate.mechanics.forward import SolveCounts
from palpate.mechanics.solvers.contract import Factorisation
from palpate.mesh.space import Constraint
from palpate.progress import Progress, silent

REACH = 0.8  # distance in ln E within which the expansion is trusted
COARSE = 3e-2  # relative residual of the forces at the equilibrium whose stiffness is factorised
DERIVATIVES = 1e-4  # relative residual of derivatives at a coarse equilibrium; those that decide are replaced later
FEW = 24  # for so many moduli and modes, all derivatives cost less than the iterations that they save


@dataclass(frozen=True, slots=True)
class Expansion:
    """u_0 + T [ln E - ln E_0, q - q_0] around an equilibrium; implements `Approximation`.

    derivatives_at (n_regions,) kPa: moduli where T was last made exact along the directions that decide; None: nowhere
    yet, it is that of an earlier equilibrium. few: moduli and modes, up to which all derivatives are made exact.
    """

    model: FirstOrderModel
    equilibrium: FiniteStrainEquilibrium = field(repr=False)
    counts: SolveCounts
    derivatives_at: NDArray[np.float64] | None = None
    few: int = FEW

    @property
    def constraint(self) -> Constraint:
        """What is prescribed to the full model."""
        return self.equilibrium.model.constraint

    @property
    def factorisation(self) -> Factorisation | None:
        """That of the tangent stiffness near the equilibrium."""
        return self.equilibrium.factorisation

    @property
    def trust_radius(self) -> float:
        """As far as it is trusted."""
        return REACH

    @property
    def place(self) -> LinearisationPoint:
        """Where it is exact."""
        return LinearisationPoint(self.equilibrium.moduli, self.equilibrium.coefficients)

    def update(self, at: LinearisationPoint) -> Expansion:
        """The expansion around the equilibrium at another place, derivatives exact there along its directions.

        Along all where they are few. With directions D, the exact C along them and H the metric T becomes
        T + (C - T D) (D^T H D)^+ D^T H: of all T' with T' D = C the one that changes least. The other columns stay as
        they were where T was made. Raises `NotConverged` when there is no equilibrium.
        """
        there, before = self, self.equilibrium
        if not at.same_as(self.place):  # start at the displacement of the expansion, else at the present one
            start = self.model.solve(at.moduli, at.coefficients).displacement
            found = before.model.attempt(at.moduli, at.coefficients, start=start, nearby=before.factorisation)
            if not found.converged:
                found = before.model.attempt(at.moduli, at.coefficients, start=before.displacement)
            if not found.converged:
                raise NotConverged(f"no equilibrium near the estimate: {found.reason}")
            there = self._around(found)
        if at.directions is None or at.metric is None:
            return there
        every = there.model.n_regions + there.model.n_modes <= self.few
        directions = np.eye(len(at.directions)) if every else at.directions
        known = there.model.derivatives @ directions
        change = there.equilibrium.tangent_along(directions, known) - known
        with determined():
            share = np.linalg.pinv(directions.T @ at.metric @ directions, hermitian=True) @ (directions.T @ at.metric)
        sharper = replace(there.model, derivatives=there.model.derivatives + change @ share)
        spent = there.counts + SolveCounts(tangent=directions.shape[1])
        return replace(there, model=sharper, counts=spent, derivatives_at=there.equilibrium.moduli)

    @classmethod
    def update_all(cls, each: Sequence[Expansion], points: Sequence[LinearisationPoint]) -> list[Expansion]:
        """Those of several states, one after the other: each has a tangent stiffness of its own."""
        return [one.update(at) for one, at in zip(each, points, strict=True)]

    @property
    def error_counts(self) -> SolveCounts:
        """One right-hand side with the factorisation that is there."""
        return SolveCounts(forward=1)

    def error(self, at: LinearisationPoint) -> ModelError:
        """An estimate (see `FiniteStrainEquilibrium.error_estimate`); nothing at its own equilibrium."""
        displacement = self.model.solve(at.moduli, at.coefficients).values
        if at.same_as(self.place):
            return ModelError(0.0, np.zeros_like(displacement))
        return ModelError(*self.equilibrium.error_estimate(at.moduli, at.coefficients, displacement))

    def at_equilibrium(self, at: LinearisationPoint, *, tolerance: float) -> Expansion:
        """The expansion around the equilibrium at a place near by, to a tolerance of the forces; `NotConverged`."""
        model, nearby = self.equilibrium.model.to_tolerance(tolerance), self.factorisation
        start = self.model.solve(at.moduli, at.coefficients).displacement
        return self._around(from_start(model, at.moduli, at.coefficients, start=start, nearby=nearby))

    def _around(self, there: FiniteStrainEquilibrium) -> Expansion:
        """The expansion around an equilibrium near enough to keep the derivatives, which takes a third of the time."""
        model = replace(self.model, moduli=there.moduli, coefficients=there.coefficients, values=there.values)
        return replace(self, model=model, equilibrium=there, counts=self.counts + there.counts)


def coarse_equilibrium(
    model: FiniteStrainModel, linear: Approximation, at: LinearisationPoint
) -> FiniteStrainEquilibrium:
    """The equilibrium near the linear law's displacement at a place, to 3 % of the forces, where an expansion begins.

    It keeps no factorisation. Raises `NotConverged` with the element and the share of the motion where the path ended.
    """
    start = linear.model.solve(at.moduli, at.coefficients).displacement
    rough, nearby = model.to_tolerance(COARSE), linear.factorisation
    found = from_start(rough, at.moduli, at.coefficients, start=start, nearby=nearby)
    return replace(found, path=replace(found.path, factorisation=None))


def expansion_around(coarse: FiniteStrainEquilibrium, *, tolerance: float, progress: Progress = silent) -> Expansion:
    """The expansion around the equilibrium beside a coarse one, with all derivatives.

    tolerance: of the forces, of every equilibrium that follows. Its factorisation is the only one: it serves all solves
    that stay near. Raises `NotConverged` as `coarse_equilibrium` does.
    """
    progress("finite strain: factorising the tangent stiffness")
    full, moduli, coefficients = coarse.model.to_tolerance(tolerance), coarse.moduli, coarse.coefficients
    try:
        near = coarse.refactorised()
        progress("finite strain: the equilibrium with this factor")
        found = from_start(full, moduli, coefficients, start=near.displacement, nearby=near.factorisation)
    except SolverError:  # a slender body is stable in equilibrium, and not near it
        progress("finite strain: the tangent stiffness is not stable; the equilibrium comes first")
        near = from_start(full, moduli, coefficients, start=coarse.displacement, nearby=None).refactorised()
        found = near
    progress(f"finite strain: derivatives with respect to {len(full.names)} moduli and {len(coefficients)} modes")
    derivatives = FirstOrderModel(full.names, moduli, coefficients, found.values, near.tangent(tolerance=DERIVATIVES))
    return Expansion(derivatives, found, near.counts + near.tangent_counts + found.counts)
