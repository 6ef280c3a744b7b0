"""What a driver's wall does on a finer scale than its modes."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from palpate.inversion.objective import Evaluation, Objective
from palpate.mesh.constraint import Constraint

__all__ = ["refined_walls"]

FINE_KERNEL_MM = 8.0  # correlation length of what a wall does beyond its modes


def refined_walls(objective: Objective, evaluation: Evaluation) -> list[Constraint | None]:
    """Each state's constraint with a finer motion of the wall in its offset; None where no driver asks for it.

    The correction is found anew each time, jointly over all outer iterations with the modes and the moduli (block
    coordinate descent), from the residuals of an evaluation (see `Observation.wall_motion`).
    """
    refined: list[Constraint | None] = []
    for s, state in enumerate(objective.states):
        rest, present = state.model.constraint, state.constraint
        offset, asked = present.offset.copy(), False
        for line in (line for line in evaluation.lines if line.state == s):
            dofs = line.observation.dofs
            motion = line.observation.wall_motion(
                line.residuals, present=(present.offset - rest.offset)[dofs], kernel_mm=FINE_KERNEL_MM
            )
            if motion is not None:
                moves = np.any(rest.modes[dofs] != 0.0, axis=1)  # not where a bone holds the wall
                offset[dofs], asked = rest.offset[dofs] + np.where(moves, motion, 0.0), True
        refined.append(replace(present, offset=offset) if asked else None)
    return refined
