"""The driver's motion when the moduli are known: its wall brought to the later image, the organs following."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from palpate.approximation.contract import Approximation, LinearisationPoint
from palpate.approximation.expansion import coarse_equilibrium, expansion_around
from palpate.approximation.reduced_basis import reduced_basis
from palpate.errors import NotConverged
from palpate.inversion.hyper_parameters import with_amplitudes
from palpate.inversion.later_state import InverseProblem
from palpate.inversion.objective import Objective
from palpate.inversion.starts import fit_coefficients
from palpate.mechanics.equilibrium import ACCURACY
from palpate.observation.noise_model import SEGMENTATION_NOISE

FITS, TOLERANCE = 25, 1e-3  # of the wall

Motions = tuple[NDArray[np.float64], ...]


def fit_driver(
    problem: InverseProblem, moduli: NDArray[np.float64], *, shares: Sequence[float] = (1.0,)
) -> tuple[Motions, ...]:
    """Displacements (n_points, 3) mm of each later image at moduli (n_regions,) kPa and at shares of its motion.

    Under the states' finite-strain law, where they have one, every share is in equilibrium. Raises `NotConverged` when
    the driver's wall cannot be brought to the images, or a path ends early.
    """
    objective = Objective(problem.states, replace(problem.parameters, base=moduli))
    linear = [reduced_basis(state.model, moduli) for state in problem.states]
    amounts = _fitted(objective, linear, np.zeros(problem.parameters.n_coefficients))
    if not problem.finite_strain:
        motions = [basis.model.solve(moduli, q).displacement for basis, q in zip(linear, amounts, strict=True)]
        return tuple(tuple(share * motion for share in shares) for motion in motions)
    first = []
    for state, basis, q in zip(problem.states, linear, amounts, strict=True):
        assert state.finite_strain is not None
        coarse = coarse_equilibrium(state.finite_strain, basis, LinearisationPoint(moduli, q))
        first.append(expansion_around(coarse, tolerance=ACCURACY))
    amounts = _fitted(objective, first, np.concatenate(amounts))
    found = []
    for near, q in zip([expansion.equilibrium for expansion in first], amounts, strict=True):
        states, offset = list[NDArray[np.float64]](), near.model.constraint.offset
        for share in shares:  # each from the one before it
            constraint = replace(near.model.constraint, offset=share * offset)
            model = near.model.with_conditions(replace(near.model.conditions, constraint=constraint))
            start = states[-1] if states else share * near.displacement
            states.append(model.solve(near.moduli, share * q, start=start).displacement)
        found.append(tuple(states))
    return tuple(found)


def _fitted(
    objective: Objective, models: Sequence[Approximation], coefficients: NDArray[np.float64]
) -> list[NDArray[np.float64]]:
    """Driver coefficients of each state that bring the walls to the images, from given ones, all in one row."""
    still = np.zeros(objective.n_parameters)
    objective = objective.with_approximations(models).with_observations(
        [o.with_noise(SEGMENTATION_NOISE) for o in objective.observations]
    )
    first = fit_coefficients(objective, np.concatenate([still, coefficients]))
    objective = with_amplitudes(objective, first.evaluation, first.unknowns)
    found = fit_coefficients(objective, first.unknowns, fits=FITS, tolerance=TOLERANCE)
    if not found.converged:
        raise NotConverged(f"the driver's wall could not be fitted to the later image: {found.outcome.value}")
    return objective.parameters.coefficients(found.unknowns)
