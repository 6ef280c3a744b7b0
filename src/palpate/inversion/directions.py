"""The directions of the unknowns that decide the moduli and their intervals."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from palpate.inversion.objective import Evaluation, Objective

__all__ = ["deciding_directions"]


def deciding_directions(objective: Objective, evaluation: Evaluation) -> list[NDArray[np.float64]]:
    """Directions (n_regions + n_modes, 2 n_parameters) of each state's (ln E, q), dimensionless.

    First the unit vectors e_i of the log-moduli, then h_i = H^-1 e_i with the Gauss-Newton matrix H. Where the
    derivatives J h_i of the residuals are exact, so are to first order in an error of the other columns of J the
    moduli's part of the step, e_i^T H^-1 J^T W r = (J h_i)^T W r + ..., their gain (J h_i)^T W and their variance
    e_i^T H^-1 e_i, whose variation is -2 (dJ h_i)^T W J h_i.
    """
    n = objective.n_parameters
    decisive = np.linalg.solve(evaluation.matrix, np.eye(len(evaluation.matrix))[:, :n])
    unknowns = np.concatenate([np.eye(len(decisive))[:, :n], decisive], axis=1)
    found = []
    ends = np.cumsum([state.model.n_modes for state in objective.states])[:-1]
    for state, by_mode in zip(objective.states, np.split(unknowns[n:], ends), strict=True):
        by_region = np.zeros((state.model.n_regions, 2 * n))
        by_region[objective.modulus_map.columns] = unknowns[:n]
        found.append(np.concatenate([by_region, by_mode]))
    return found
