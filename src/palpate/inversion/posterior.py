"""Covariance of the estimate under spatially correlated residuals: a sandwich around the Gauss-Newton matrix."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from palpate.inversion.noise import NoiseLaw
from palpate.inversion.objective import Evaluation

__all__ = ["gain", "later_states", "sandwich_covariance"]


def gain(evaluation: Evaluation, n_parameters: int) -> tuple[NDArray[np.float64], ...]:
    """Derivative (n_parameters, n_residuals) of the estimated log-moduli by the residuals of each surface, 1/mm.

    G = H^-1 J^T W: a change e of the data moves the estimate by -G e; H is the Gauss-Newton matrix with the prior.
    """
    rows = np.linalg.solve(evaluation.matrix, np.eye(len(evaluation.matrix))[:, :n_parameters]).T
    return tuple(rows[:, s.columns] @ (s.precision * s.weights[:, None] * s.jacobian).T for s in evaluation.surfaces)


def sandwich_covariance(evaluation: Evaluation, law: NoiseLaw, n_parameters: int) -> NDArray[np.float64]:
    """Covariance (n_parameters, n_parameters) of the log-moduli: H^-1 (J^T W C W J + P) H^-1.

    C is the covariance of the residuals under `law`, across all surfaces; P the prior of the driver's coefficients,
    whose uncertainty is thereby included (White 1980; Aitken's theorem read for correlated errors). A residual is the
    error of a later image less that of its rest state's image, each with half of the law: the later ones are
    independent, that of the rest state is the same for all states that have it, at the material place. Later states
    that move alike do not average it away, opposite ones do.
    """
    inverse = np.linalg.solve(evaluation.matrix, np.eye(len(evaluation.matrix))[:, :n_parameters])
    data, rows = np.zeros((n_parameters, n_parameters)), gain(evaluation, n_parameters)
    residuals = [s.residuals for s in evaluation.surfaces]

    def spread(group: Sequence[int], places: Sequence[NDArray[np.float64]]) -> NDArray[np.float64]:
        """Half of G C G^T of some surfaces together, at places (n, 3) mm of each."""
        normals = np.concatenate([residuals[i].normals for i in group])
        carried = np.concatenate([rows[i] for i in group], axis=1)
        return 0.5 * law.covariance(carried, np.concatenate([places[i] for i in group]), normals)

    for group in later_states(evaluation):
        data += spread(group, [r.places for r in residuals])
    for group in _rest_states(evaluation):
        data += spread(group, [r.material for r in residuals])
    return np.asarray(data + inverse.T @ evaluation.prior @ inverse)


def later_states(evaluation: Evaluation) -> Sequence[list[int]]:
    """Numbers of the surfaces of each later state."""
    states = [surface.state for surface in evaluation.surfaces]
    return [[i for i, state in enumerate(states) if state == key] for key in dict.fromkeys(states)]


def _rest_states(evaluation: Evaluation) -> Sequence[list[int]]:
    """Numbers of the surfaces of each rest state, whose later states have the very same observed surfaces."""
    groups: list[list[int]] = []
    for state in later_states(evaluation):
        surface = evaluation.surfaces[state[0]].target.surface
        known = [group for group in groups if evaluation.surfaces[group[0]].target.surface is surface]
        if known:
            known[0].extend(state)
        else:
            groups.append(list(state))
    return groups
