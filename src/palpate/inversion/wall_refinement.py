"""Driver walls that move on a finer scale than their modes: what is left on their surfaces is prescribed as well."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from palpate.inversion.noise import NoiseLaw
from palpate.inversion.objective import Linearisation
from palpate.inversion.problem import InverseProblem
from palpate.mesh.constraint import Constraint
from palpate.observation.wall_correction import wall_correction

__all__ = ["REFINEMENTS", "refined_walls"]

REFINEMENTS = 2  # of an estimate's walls; what is left then is no motion that they could follow
ROUGH = 1.5  # times the law's variance: a driver's residual mean square above it is motion, not noise
FINEST = 5e-3  # mm, root mean square: less moves no modulus


def refined_walls(
    problem: InverseProblem, constraints: tuple[Constraint, ...], lines: tuple[Linearisation, ...], law: NoiseLaw
) -> tuple[Constraint, ...]:
    """The constraints, with a finer motion of the wall in their offset where a driver's residuals exceed the law.

    constraints: each state's as it stands; `lines`: the surfaces at the present estimate. The correction is found anew
    each time, jointly over all rounds with the modes and the moduli (block coordinate descent), from the residuals with
    the precision of the law. A constraint that stays is the same object.
    """
    refined = list(constraints)
    for line in lines:
        if line.target.surface.name in problem.drivers and _mean_square(line) > max(ROUGH * law.sd**2, FINEST**2):
            state = line.state
            refined[state] = _refined(
                refined[state], problem.models[state].constraint, line, law, problem.fine_kernel_mm
            )
    return tuple(refined)


def _refined(
    constraint: Constraint, rest: Constraint, line: Linearisation, law: NoiseLaw, kernel_mm: float
) -> Constraint:
    surface = line.target.surface
    present = (constraint.offset - rest.offset)[surface.dofs].reshape(-1, 3)
    area = float(line.target.area.sum())
    precision = line.residuals.weights * max(area / law.correlation_area, 1.0) / law.sd**2
    prior = float(np.sqrt(_mean_square(line)))
    correction = wall_correction(
        surface, line.residuals, precision, present=present, kernel_mm=kernel_mm, prior_mm=prior
    )
    moves = np.any(rest.modes[surface.dofs] != 0.0, axis=1)  # not where a bone holds the wall
    offset = rest.offset.copy()
    offset[surface.dofs] += np.where(moves, correction.ravel(), 0.0)
    return replace(constraint, offset=offset)


def _mean_square(line: Linearisation) -> float:
    """Area-weighted mean square residual, mm^2."""
    return float(np.average(np.square(line.residuals.values), weights=line.residuals.weights))
