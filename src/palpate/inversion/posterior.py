"""Covariance of the estimate under spatially correlated residuals: a sandwich around the Gauss-Newton matrix."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from palpate.inversion.noise import NoiseLaw
from palpate.inversion.objective import Evaluation

MAX_FACES = 2500  # of one surface, in the dense covariance of the Cramer-Rao limit

__all__ = ["cramer_rao", "gain", "sandwich_covariance"]


def gain(evaluation: Evaluation, n_parameters: int) -> tuple[NDArray[np.float64], ...]:
    """Derivative (n_parameters, n_residuals) of the estimated log-moduli by the residuals of each surface, 1/mm.

    G = H^-1 J^T W: a change e of the data moves the estimate by -G e; H is the Gauss-Newton matrix with the prior.
    """
    rows = np.linalg.solve(evaluation.matrix, np.eye(len(evaluation.matrix))[:, :n_parameters]).T
    return tuple(rows @ (s.precision * s.weights[:, None] * s.jacobian).T for s in evaluation.surfaces)


def sandwich_covariance(evaluation: Evaluation, law: NoiseLaw, n_parameters: int) -> NDArray[np.float64]:
    """Covariance (n_parameters, n_parameters) of the log-moduli: H^-1 (J^T W C W J + P) H^-1.

    C is the covariance of the residuals under `law`, across all surfaces; P the prior of the driver's coefficients,
    whose uncertainty is thereby included (White 1980; Aitken's theorem read for correlated errors).
    """
    inverse = np.linalg.solve(evaluation.matrix, np.eye(len(evaluation.matrix))[:, :n_parameters])
    data = np.zeros((n_parameters, n_parameters))
    places = [s.residuals.places for s in evaluation.surfaces]
    normals = [s.residuals.normals for s in evaluation.surfaces]
    for group in _states(evaluation):
        rows = np.concatenate([g for i, g in enumerate(gain(evaluation, n_parameters)) if i in group], axis=1)
        data += law.covariance(
            rows, np.concatenate([places[i] for i in group]), np.concatenate([normals[i] for i in group])
        )
    return np.asarray(data + inverse.T @ evaluation.prior @ inverse)


def cramer_rao(evaluation: Evaluation, law: NoiseLaw, n_parameters: int) -> NDArray[np.float64]:
    """Smallest covariance (n_parameters, n_parameters) of the log-moduli that any unbiased estimate can have.

    Inverse of the Fisher information F = sum_states J^T C^-1 J + P over the model's faces (model -> image residuals),
    each face once, with the prior of the driver's motion.
    """
    information = evaluation.prior.copy()
    for group in _states(evaluation):
        parts = [_face_means(evaluation, i) for i in group]
        jacobian, places, normals = (np.concatenate([part[k] for part in parts]) for k in range(3))
        distance2 = np.sum((places[:, None] - places[None]) ** 2, axis=2)
        covariance = sum(
            variance * np.exp(-distance2 / (2.0 * length**2))
            for variance, length in zip(law.variances, law.lengths, strict=True)
        ) * (normals @ normals.T)
        covariance += 1e-4 * law.sd**2 * np.eye(len(places))
        information += jacobian.T @ np.linalg.solve(covariance, jacobian)
    return np.asarray(np.linalg.inv(information)[:n_parameters, :n_parameters])


def _states(evaluation: Evaluation) -> Sequence[list[int]]:
    """Numbers of the surfaces of each image; the errors of different images are independent."""
    states = [surface.state for surface in evaluation.surfaces]
    return [[i for i, state in enumerate(states) if state == key] for key in dict.fromkeys(states)]


def _face_means(
    evaluation: Evaluation, surface: int
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Jacobian rows, places and normals of the model -> image residuals, averaged over groups of neighbours."""
    line = evaluation.surfaces[surface]
    size = max(int(np.ceil(len(line.target.area) / MAX_FACES)), 1)
    n = len(line.target.area) // size
    jacobian, places, normals = (
        part[: n * size].reshape(n, size, -1).mean(axis=1)
        for part in (line.jacobian, line.residuals.places, line.residuals.normals)
    )
    return jacobian, places, normals
