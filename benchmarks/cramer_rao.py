"""The Cramer-Rao limit of moduli from surfaces and points: the least error of any unbiased method."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.spatial.distance import cdist

from palpate.inversion import Evaluation, Linearisation
from palpate.observation import NoiseModel, Observation, PointDisplacement, SurfaceDistance, SurfaceTarget

__all__ = ["cramer_rao", "efficient_gain", "fisher_information", "model_to_image", "target_of"]

RIDGE = 1e-4  # of the variance of a residual, on the cells' covariance
ROWS = 64  # cells whose pairs are in memory at once


def cramer_rao(evaluation: Evaluation, noise: NoiseModel, n_parameters: int, *, cell_mm: float) -> NDArray[np.float64]:
    """Smallest covariance (n_parameters, n_parameters) of the log-moduli that any unbiased estimate can have.

    Inverse of the Fisher information F = sum_states J^T C^-1 J + P of the model -> image residuals' means over cells of
    the surfaces, with the prior P of the other unknowns. Points whose motion was measured add theirs, by the covariance
    stated, which makes their residuals independent. Of several later states each is taken with a first image of its
    own.

    `cell_mm`: the noise's correlation length. Within it a smooth model leaves next to no noise, so that single
    faces would tell moduli from the differences of neighbours, which are rounding that no such model describes: a limit
    that its own weights miss by far.
    """
    inverse = np.linalg.inv(fisher_information(evaluation, noise, cell_mm=cell_mm) + evaluation.prior.dense)
    return np.asarray(inverse[:n_parameters, :n_parameters])


def fisher_information(evaluation: Evaluation, noise: NoiseModel, *, cell_mm: float) -> NDArray[np.float64]:
    """sum_states J^T C^-1 J (n_unknowns, n_unknowns) of the data alone, as `cramer_rao` has it."""
    return _information(evaluation, _whitened_states(evaluation, noise, cell_mm)) + _of_points(evaluation)


def efficient_gain(
    evaluation: Evaluation, noise: NoiseModel, n_parameters: int, *, cell_mm: float
) -> tuple[NDArray[np.float64], ...]:
    """Derivative (n_parameters, n_q) of the log-moduli by each surface's model -> image residuals, 1/mm, at the limit.

    G = F^-1 J^T C^-1 on the cells' means: of all weights without bias those of least variance (Aitken 1935). Under
    noise of this model, G C G^T with the prior's part is the limit of `cramer_rao`.
    """
    states = _whitened_states(evaluation, noise, cell_mm)
    information = _information(evaluation, states) + _of_points(evaluation)
    inverse = np.linalg.inv(information + evaluation.prior.dense)[:n_parameters]
    found: list[NDArray[np.float64]] = []
    for state in states:
        rows = np.asarray(inverse[:, state.lines[0].columns] @ state.weighted.T @ state.means)
        found += np.split(rows, np.cumsum([model_to_image(line).stop for line in state.lines])[:-1], axis=1)
    return tuple(found)


@dataclass(frozen=True, slots=True)
class _Whitened:
    """One later state: its surfaces, C^-1 J (n_cells, n_columns) and the matrix (n_cells, n_q) of the cells' means."""

    lines: Sequence[Linearisation]
    weighted: NDArray[np.float64]
    means: sparse.csr_matrix[np.float64]


def target_of(observation: Observation) -> SurfaceTarget:
    """What a surface distance compares; raises `TypeError` for an observation of another kind."""
    if not isinstance(observation, SurfaceDistance):
        raise TypeError(f"the limit is that of surface distances; '{observation.name}' is a {observation.kind}")
    return observation.target


def model_to_image(line: Linearisation) -> slice:
    """Rows of the residuals of the direction model -> image, one a quadrature point of the surface."""
    return slice(0, len(target_of(line.observation).area))


def _whitened_states(evaluation: Evaluation, noise: NoiseModel, cell_mm: float) -> list[_Whitened]:
    seen = [line for line in evaluation.linearisations if isinstance(line.observation, SurfaceDistance)]
    states = dict.fromkeys(line.state for line in seen)
    return [_whitened([line for line in seen if line.state == s], noise, cell_mm) for s in states]


def _of_points(evaluation: Evaluation) -> NDArray[np.float64]:
    """J^T J / sd^2 (n, n) of all unknowns by the residuals of points, which have one standard deviation and no more."""
    information = np.zeros((evaluation.prior.size,) * 2)
    for line in evaluation.linearisations:
        if isinstance(line.observation, PointDisplacement):
            weights = np.full(len(line.weights), line.observation.stated.sd**-2.0)
            information[np.ix_(line.columns, line.columns)] += line.jacobian.gram(weights)
    return information


def _information(evaluation: Evaluation, states: Sequence[_Whitened]) -> NDArray[np.float64]:
    """That of the surfaces (n, n), of all unknowns."""
    information = np.zeros((evaluation.prior.size,) * 2)
    for state in states:
        columns = state.lines[0].columns
        seen = np.asarray(state.means @ _jacobian(state.lines))
        information[np.ix_(columns, columns)] += state.weighted.T @ seen
    return information


def _whitened(lines: Sequence[Linearisation], noise: NoiseModel, cell_mm: float) -> _Whitened:
    means = sparse.csr_matrix(sparse.block_diag([_cell_means(line, cell_mm) for line in lines]))
    places = np.concatenate([line.residuals.places[model_to_image(line)] for line in lines])
    normals = np.concatenate([line.residuals.normals[model_to_image(line)] for line in lines])
    covariance = np.zeros((means.shape[0],) * 2)
    for start in range(0, means.shape[0], ROWS):
        block = means[start : start + ROWS]
        touched = np.unique(block.indices)
        distance2 = cdist(places[touched], places, "sqeuclidean")
        pairs = sum(
            variance * np.exp(-distance2 / (2.0 * length**2))
            for variance, length in zip(noise.variances, noise.lengths, strict=True)
        ) * (normals[touched] @ normals.T)
        covariance[start : start + ROWS] = block[:, touched] @ (means @ pairs.T).T
    covariance[np.diag_indices_from(covariance)] += RIDGE * noise.sd**2
    weighted = np.linalg.solve(covariance, np.asarray(means @ _jacobian(lines)))
    return _Whitened(lines, np.asarray(weighted), means)


def _jacobian(lines: Sequence[Linearisation]) -> NDArray[np.float64]:
    """Derivative (n_q, n_columns) of the surfaces' model -> image residuals, one surface after the other."""
    return np.concatenate([line.jacobian.of_rows(model_to_image(line)).dense for line in lines])


def _cell_means(line: Linearisation, edge_mm: float) -> sparse.csr_matrix[np.float64]:
    """Matrix (n_cells, n_q) of means by area over cubes; what looks to other sides is kept apart."""
    area = target_of(line.observation).area
    rows = model_to_image(line)
    places, normals = line.residuals.places[rows], line.residuals.normals[rows]
    number = np.unique(np.column_stack([np.floor(places / edge_mm), normals > 0.0]), axis=0, return_inverse=True)[1]
    number = number.ravel()
    share = area / np.bincount(number, area)[number]
    return sparse.csr_matrix((share, (number, np.arange(len(area)))))
