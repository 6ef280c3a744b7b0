"""What is believed of the drivers' motion before the organs are asked: learned from the images by its evidence.

A wall that moves by 3 mm as one piece must not be allowed to slide by 5 mm on its own: nothing in the images holds it
back along itself, and the moduli then pay for it.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy import linalg, optimize

from palpate.inversion.objective import Evaluation
from palpate.inversion.problem import InverseProblem
from palpate.observation.wall_modes import Wall

__all__ = ["learned_prior"]

LENGTHS = (1.0, 1.4, 2.0, 2.8, 4.0)  # times the modes' own kernel, which they cannot go below
AMPLITUDES = (0.02, 4.0)  # times the modes' own standard deviation


def learned_prior(
    problem: InverseProblem, evaluation: Evaluation, unknowns: NDArray[np.float64]
) -> NDArray[np.float64] | None:
    """Precision P (n_coefficients, n_coefficients) with the largest evidence; None where the walls are not given.

    Each wall's motion is a Gaussian process, kernel length and standard deviation of its own. With the residuals
    linear around `unknowns` (n_unknowns,), A = J^T W J and b = A x - J^T W r, the log-evidence is
    1/2 (b^T (A + P)^-1 b - ln det(A + P) + ln det P) up to a constant (MacKay 1992, Neural Computation 4, eq. 2.4; the
    log-moduli have no prior).
    """
    if not any(problem.walls):
        return None
    data = evaluation.matrix - evaluation.prior
    pull = data @ unknowns - (evaluation.score - evaluation.prior @ unknowns)
    n_parameters = len(problem.modulus_map.tissues)
    prior, start = evaluation.prior.copy(), n_parameters
    for model, walls in zip(problem.models, problem.walls, strict=True):
        for wall in walls:
            block = np.ix_(start + wall.columns, start + wall.columns)
            prior[block] = _most_evident(wall, data, pull, prior, block)
        start += model.n_modes
    return prior[n_parameters:, n_parameters:]


def _most_evident(
    wall: Wall,
    data: NDArray[np.float64],
    pull: NDArray[np.float64],
    prior: NDArray[np.float64],
    block: tuple[NDArray[np.intp], ...],
) -> NDArray[np.float64]:
    """The wall's precision (n_modes, n_modes) with the largest evidence, the other walls' as in `prior`."""
    limits = np.log(AMPLITUDES)
    found: list[tuple[float, NDArray[np.float64]]] = []
    for length in LENGTHS:
        unit = np.kron(np.linalg.inv(wall.covariance(length * wall.kernel_mm)), np.eye(3))

        def worse(amplitude: float, unit: NDArray[np.float64] = unit) -> float:
            """Minus the log-evidence at ln(standard deviation / the modes' own)."""
            trial = prior.copy()
            trial[block] = unit * np.exp(-2.0 * amplitude)
            return -_log_evidence(data, pull, trial)

        best = optimize.minimize_scalar(worse, bounds=(limits[0], limits[1]), method="bounded", options={"xatol": 0.01})
        found.append((float(best.fun), unit * np.exp(-2.0 * float(best.x))))
    return min(found, key=lambda pair: pair[0])[1]


def _log_evidence(data: NDArray[np.float64], pull: NDArray[np.float64], prior: NDArray[np.float64]) -> float:
    scale = np.sqrt(np.maximum(np.diag(data + prior), 1e-30))
    matrix = (data + prior) / np.outer(scale, scale)
    matrix[np.diag_indices_from(matrix)] += 1e-10  # a modulus that moves nothing
    factor = linalg.cholesky(matrix, lower=True, check_finite=False)
    inner = linalg.solve_triangular(factor, pull / scale, lower=True, check_finite=False)
    held = np.diag(prior) > 0.0
    before = np.linalg.slogdet(prior[np.ix_(held, held)])[1]
    after = 2.0 * float(np.sum(np.log(np.diag(factor)))) + 2.0 * float(np.sum(np.log(scale)))
    return 0.5 * (float(inner @ inner) - after + float(before))
