"""The drivers' motion: what is believed of it, learned from the images by its evidence, and its finer part.

A wall that moves by 3 mm as one piece must not be allowed to slide by 5 mm on its own: nothing in the images holds it
back along itself, and the moduli then pay for it. Nor must one that swells be taken for one that drifts.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import product

import numpy as np
from numpy.typing import NDArray
from scipy import linalg, optimize

from palpate.inversion.objective import Evaluation, Objective, determined
from palpate.mesh.constraint import Constraint

__all__ = ["learned_precision", "refined_walls", "with_learned_prior"]

AMPLITUDES = (0.005, 2.0)  # times the modes' own standard deviation
FIRST_AMPLITUDES = ((0.3, 0.05), (0.05, 0.3))  # of drift and swelling; one may hide the other
LEAST_VARIANCE = 1e-3  # of a coefficient, times its variance under the modes' own kernel: no mode is forbidden
ALIKE = 2.0  # of the log-evidence
FINE_KERNEL_MM = 8.0  # correlation length of what a wall does beyond its modes


@dataclass(frozen=True, slots=True)
class _Seen:
    """What the data say of one wall when all else follows: information A (n, n) and pull b = A x - J^T W r (n,)."""

    information: NDArray[np.float64]
    pull: NDArray[np.float64]

    def along(self, basis: NDArray[np.float64]) -> _Seen:
        """The same of amounts y (k,) of a basis W (n, k), x = W y."""
        return _Seen(basis.T @ self.information @ basis, basis.T @ self.pull)

    def log_evidence(self, variances: NDArray[np.float64]) -> tuple[float, NDArray[np.float64]]:
        """F = 1/2 (b^T (A + C^-1)^-1 b - ln det(1 + C A)) for a prior covariance C = diag(v) (n, n), and dF / d ln v_i.

        With S = (A + C^-1)^-1 and x = S b the derivative is 1/2 ((x_i^2 + S_ii) / v_i - 1).
        """
        root = np.sqrt(variances)
        inner = root[:, None] * self.information * root
        inner[np.diag_indices_from(inner)] += 1.0
        factor = linalg.cholesky(inner, lower=True, overwrite_a=True, check_finite=False)
        inverse, _ = linalg.lapack.dtrtri(factor, lower=1)
        explained = inverse @ (root * self.pull)
        evidence = 0.5 * float(explained @ explained) - float(np.sum(np.log(np.diag(factor))))
        scaled = inverse.T @ explained  # x / root
        return evidence, 0.5 * (scaled**2 + np.sum(inverse**2, axis=0) - 1.0)


def learned_precision(
    objective: Objective, evaluation: Evaluation, unknowns: NDArray[np.float64]
) -> NDArray[np.float64] | None:
    """Precision P (n_coefficients, n_coefficients) with the largest evidence; None where no walls are given.

    Each wall's motion is the sum of two Gaussian processes, a drift and a swelling (see `Wall`), with kernel lengths
    and standard deviations of their own. With the residuals linear around `unknowns` x (n_unknowns,), A = J^T W J and
    b = A x - J^T W r, the log-evidence of P is 1/2 (b^T (A + P)^-1 b - ln det(A + P) + ln det P) up to a constant
    (MacKay 1992, Neural Computation 4, 415-447, section 4). Of kernels whose evidence is as good as equal, those that
    leave the log-moduli the widest posterior. Raises `EstimationError` where a wall's motion is left open.
    """
    if not any(state.walls for state in objective.states):
        return None
    data = evaluation.matrix - evaluation.prior
    pull = data @ unknowns - (evaluation.score - evaluation.prior_score)
    n_parameters, prior = objective.n_parameters, evaluation.prior.copy()
    for s, state in enumerate(objective.states):
        own = objective.parameters.unknowns_of(s)[n_parameters:]
        for wall in state.walls:
            places = own[wall.columns]
            with determined():
                seen = _seen(data + prior, data, pull, places)
                beliefs = [_most_evident(pair, seen) for pair in product(wall.drifts, wall.swellings)]
                best = max(evidence for evidence, _ in beliefs)
                found = list[tuple[float, float, NDArray[np.float64]]]()
                for evidence, covariance in beliefs:
                    if evidence > best - ALIKE:
                        with_it = prior.copy()
                        with_it[np.ix_(places, places)] = np.linalg.inv(covariance)
                        found.append((_width(data + with_it, n_parameters), evidence, with_it))
                _, _, prior = max(found, key=lambda each: each[:2])
    return prior[n_parameters:, n_parameters:]


def with_learned_prior(objective: Objective, evaluation: Evaluation, unknowns: NDArray[np.float64]) -> Objective:
    """The objective with the drivers' prior of the largest evidence around unknowns (n_unknowns,)."""
    precision = learned_precision(objective, evaluation, unknowns)
    if precision is None:
        return objective
    return replace(objective, parameters=replace(objective.parameters, driver_precision=precision))


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


def _seen(
    matrix: NDArray[np.float64], data: NDArray[np.float64], pull: NDArray[np.float64], places: NDArray[np.int64]
) -> _Seen:
    """The Schur complement of the information `data` on the unknowns `places`, the others under their prior."""
    rest = np.setdiff1d(np.arange(len(pull)), places)
    across = data[np.ix_(rest, places)]
    scale = 1.0 / np.sqrt(np.maximum(np.diag(matrix)[rest], 1e-30))
    scaled = scale[:, None] * matrix[np.ix_(rest, rest)] * scale
    scaled[np.diag_indices_from(scaled)] += 1e-10  # a modulus that moves nothing
    right = scale[:, None] * np.column_stack([across, pull[rest]])
    followed = across.T @ (scale[:, None] * linalg.solve(scaled, right, assume_a="pos", check_finite=False))
    information = data[np.ix_(places, places)] - followed[:, :-1]
    return _Seen(0.5 * (information + information.T), pull[places] - followed[:, -1])


def _most_evident(parts: Sequence[NDArray[np.float64]], seen: _Seen) -> tuple[float, NDArray[np.float64]]:
    """The largest log-evidence of a prior of one wall's coefficients, and that prior's covariance (n_modes, n_modes).

    Sought are the weights of drift and swelling, covariances (n_modes, n_modes) at the modes' own standard deviation:
    in the common eigenvectors of both, D = W W^T and S = W diag(lambda) W^T, every sum of them is diagonal.
    """
    drift, swelling = (part + LEAST_VARIANCE * np.eye(len(part)) for part in parts)
    ratios, vectors = linalg.eigh(swelling, drift, check_finite=False)
    basis = drift @ vectors
    within = seen.along(basis)

    def shares(logs: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Both parts' shares in the variances (n,) of the eigenvectors, at ln of their amplitudes (2,)."""
        of_drift, of_swelling = np.exp(2.0 * logs)
        return np.full(len(ratios), of_drift), of_swelling * ratios

    def worse(logs: NDArray[np.float64]) -> tuple[float, NDArray[np.float64]]:
        """Minus the log-evidence, with its derivative (2,)."""
        drifts, swellings = shares(logs)
        evidence, by_log_variance = within.log_evidence(drifts + swellings)
        drifting = drifts / (drifts + swellings)
        return -evidence, -2.0 * np.array([by_log_variance @ drifting, by_log_variance @ (1.0 - drifting)])

    limits = [tuple(np.log(AMPLITUDES))] * 2
    found = [
        optimize.minimize(worse, np.log(start), jac=True, method="L-BFGS-B", bounds=limits)
        for start in FIRST_AMPLITUDES
    ]
    best = min(found, key=lambda trial: float(trial.fun))
    return -float(best.fun), (basis * sum(shares(best.x))) @ basis.T


def _width(matrix: NDArray[np.float64], n_parameters: int) -> float:
    """Sum of the log-moduli's posterior variances under a Gauss-Newton matrix (n, n)."""
    scale = 1.0 / np.sqrt(np.maximum(np.diag(matrix), 1e-30))
    inverse = np.linalg.pinv(scale[:, None] * matrix * scale, hermitian=True)
    return float(np.sum(np.diag(inverse)[:n_parameters] * scale[:n_parameters] ** 2))
