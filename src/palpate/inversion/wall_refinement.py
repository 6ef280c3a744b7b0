"""Driver walls that move on a finer scale than their modes: what is left on their surfaces is prescribed as well."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from palpate.inversion.noise import NoiseLaw
from palpate.inversion.objective import Linearisation
from palpate.mechanics.linear_model import LinearModel, with_constraint
from palpate.observation.wall_correction import wall_correction

__all__ = ["refined_walls"]

ROUGH = 1.5  # times the law's variance: a driver's residual mean square above it is motion, not noise
FINEST = 5e-3  # mm, root mean square: less moves no modulus


def refined_walls(
    models: tuple[LinearModel, ...],
    rest: tuple[LinearModel, ...],
    lines: tuple[Linearisation, ...],
    *,
    drivers: frozenset[str],
    law: NoiseLaw,
    kernel_mm: float,
) -> tuple[LinearModel, ...]:
    """The models, those with a driver whose residuals exceed the law with a finer motion of its wall in their offset.

    models: as they stand, `rest`: without any correction; `lines`: their surfaces at the present estimate. The
    correction is found anew each time, jointly over all rounds with the modes and the moduli (block coordinate
    descent), from the residuals with the precision of the law.
    """
    refined = list(models)
    for line in lines:
        if line.target.surface.name in drivers and _mean_square(line) > max(ROUGH * law.sd**2, FINEST**2):
            state = line.state
            refined[state] = _refined(refined[state], rest[state], line, law, kernel_mm)
    return tuple(refined)


def _refined(
    model: LinearModel, rest: LinearModel, line: Linearisation, law: NoiseLaw, kernel_mm: float
) -> LinearModel:
    surface = line.target.surface
    present = (model.constraint.offset - rest.constraint.offset)[surface.dofs].reshape(-1, 3)
    area = float(line.target.area.sum())
    precision = line.residuals.weights * max(area / law.correlation_area, 1.0) / law.sd**2
    prior = float(np.sqrt(_mean_square(line)))
    correction = wall_correction(
        surface, line.residuals, precision, present=present, kernel_mm=kernel_mm, prior_mm=prior
    )
    moves = np.any(rest.constraint.modes[surface.dofs] != 0.0, axis=1)  # not where a bone holds the wall
    offset = rest.constraint.offset.copy()
    offset[surface.dofs] += np.where(moves, correction.ravel(), 0.0)
    return with_constraint(model, replace(model.constraint, offset=offset))


def _mean_square(line: Linearisation) -> float:
    """Area-weighted mean square residual, mm^2."""
    return float(np.average(np.square(line.residuals.values), weights=line.residuals.weights))
