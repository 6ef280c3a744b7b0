"""Equilibrium of a body under any law when all is given: a finite-strain path begins at the linear displacement."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from palpate.mechanics.dilatation import Dilatation
from palpate.mechanics.finite_strain import FiniteStrainEquilibrium, FiniteStrainModel, finite_strain_model
from palpate.mechanics.forward import Equilibrium
from palpate.mechanics.laws.contract import Law
from palpate.mechanics.linear_model import linear_model
from palpate.mechanics.loads import Load
from palpate.mechanics.newton import NewtonSettings
from palpate.mechanics.solvers.contract import Factorisation
from palpate.mesh.space import Constraint, LagrangeSpace

ACCURACY = 1e-7  # relative residual of the forces, where the displacement's error is some nanometres


def equilibrium(
    space: LagrangeSpace,
    constraint: Constraint,
    moduli: NDArray[np.float64],
    *,
    law: Law,
    dilatation: Dilatation,
    loads: tuple[Load, ...] = (),
    strained: NDArray[np.float64] | None = None,
) -> Equilibrium:
    """Equilibrium of all meshed tissues at moduli (n_regions,) kPa; the constraint's modes do not move.

    strained: see `finite_strain_model`. Raises `NotConverged` with the element and the share of the motion where a
    finite-strain path ended.
    """
    still = np.zeros(constraint.n_modes)
    system = linear_model(space, constraint, dilatation=dilatation, loads=loads).system(moduli)
    if not law.finite:
        return system.solve(still)
    settings = NewtonSettings(tolerance=ACCURACY)
    model = finite_strain_model(
        space, constraint, law, dilatation=dilatation, loads=loads, settings=settings, strained=strained
    )
    start = system.solve(still).displacement
    return from_start(model, system.moduli, still, start=start, nearby=system.factorisation)


def from_start(
    model: FiniteStrainModel,
    moduli: NDArray[np.float64],
    coefficients: NDArray[np.float64],
    *,
    start: NDArray[np.float64],
    nearby: Factorisation | None,
) -> FiniteStrainEquilibrium:
    """Equilibrium at moduli (n_regions,) kPa and coefficients (n_modes,), from a displacement (n_points, 3) mm near it.

    Where that folds elements or leads nowhere, the path begins at rest instead. `nearby`: see `attempt`. Raises
    `NotConverged` with the element and the share of the motion where that path ended.
    """
    found = model.attempt(moduli, coefficients, start=start, nearby=nearby)
    return found if found.converged else model.solve(moduli, coefficients)
