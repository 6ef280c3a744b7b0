"""What is believed of the blocks of unknowns, learned from the images by its evidence.

A wall that moves by 3 mm as one piece must not be allowed to slide by 5 mm on its own: nothing in the images holds it
back along itself, and the moduli then pay for it. A frame that stands still must not move, a homogeneous tissue not be
patchy.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy import linalg, optimize

from palpate.inversion.blocks import Block
from palpate.inversion.objective import Evaluation, Objective, determined

FIRST, ELSEWHERE = 0.3, 0.05  # amplitudes of one term and of the others; one may hide the other
LEAST_VARIANCE = 1e-3  # of a coefficient, times its variance under the block's own kernel: no mode is forbidden
ALIKE = 2.0  # of the log-evidence
NEGLIGIBLE = 1e-3  # posterior probability of an alternative


@dataclass(frozen=True, slots=True)
class _Seen:
    """What the data say of one block when all else follows: information A (n, n) and pull b = A x - J^T W r (n,)."""

    information: NDArray[np.float64]
    pull: NDArray[np.float64]

    def log_evidence(
        self, terms: Sequence[NDArray[np.float64]], variances: NDArray[np.float64]
    ) -> tuple[float, NDArray[np.float64]]:
        """F = 1/2 (b^T (A + C^-1)^-1 b - ln det(1 + C A)) for C = sum_t v_t C_t, and dF / d v_t (n_terms,).

        With x = (A + C^-1)^-1 b, w = b - A x and G = A (1 + C A)^-1 the derivative is 1/2 (w^T C_t w - tr C_t G).
        """
        covariance = sum((v * term for v, term in zip(variances, terms, strict=True)), np.zeros_like(terms[0]))
        inner = covariance @ self.information
        inner[np.diag_indices_from(inner)] += 1.0
        factor = linalg.lu_factor(inner, overwrite_a=True, check_finite=False)
        x = linalg.lu_solve(factor, covariance @ self.pull, check_finite=False)
        left = self.pull - self.information @ x
        determinant = float(np.sum(np.log(np.abs(np.diag(factor[0])))))
        response = linalg.lu_solve(factor, self.information.T, trans=1, check_finite=False)  # G^T
        slopes = [0.5 * float(left @ term @ left - np.sum(term * response)) for term in terms]
        return 0.5 * float(self.pull @ x) - 0.5 * determinant, np.array(slopes)


def learned_precision(
    objective: Objective, evaluation: Evaluation, unknowns: NDArray[np.float64]
) -> NDArray[np.float64] | None:
    """Precision P (n_coefficients, n_coefficients) with the largest evidence; None where no block learns its own.

    With the residuals linear around `unknowns` x (n_unknowns,), A = J^T W J and b = A x - J^T W r, the log-evidence of
    P is 1/2 (b^T (A + P)^-1 b - ln det(A + P) + ln det P) up to a constant (MacKay 1992, Neural Computation 4, 415-447,
    section 4), block after block, the others under their present prior. Of alternatives whose evidence is as good as
    equal, those that leave the log-moduli the widest posterior. Raises `EstimationError` where a block is left open.
    """
    parameters = objective.parameters
    learned = [b.alternatives and not (b.last and objective.last_held) for b in parameters.blocks]
    blocks = [(parameters.columns(i), b) for i, b in enumerate(parameters.blocks) if learned[i]]
    if not blocks:
        return None
    data, n = evaluation.matrix - evaluation.prior, objective.n_parameters
    pull, prior = data @ unknowns - (evaluation.score - evaluation.prior_score), evaluation.prior.copy()
    for places, block in blocks:
        beliefs = _beliefs(block, places, data, prior, pull + prior @ parameters.prior_centre)
        with determined():
            if block.odds:
                chosen = _likeliest(beliefs, prior[np.ix_(places, places)])
            else:
                others = data + prior
                others[np.ix_(places, places)] = data[np.ix_(places, places)]
                chosen = _widest(beliefs, others, places, n)
            prior[np.ix_(places, places)] = linalg.inv(chosen)
    return prior[n:, n:]


def undecided_covariance(
    objective: Objective, evaluation: Evaluation, unknowns: NDArray[np.float64]
) -> dict[str, NDArray[np.float64]]:
    """What a covariance (n_parameters, n_parameters) lacks where alternatives were not decided, by the blocks' cause.

    The second moment about the estimate of a mixture: sum_k w_k (V_k - V + d_k d_k^T) over the alternatives of a block
    that were not chosen, with their posterior probability w_k by evidence and odds, the Gauss-Newton covariance V_k
    of the log-moduli under each, and how far d_k it moves them, with the residuals linear around unknowns (n_unknowns,)
    (law of total variance).
    """
    parameters, n = objective.parameters, objective.n_parameters
    data, prior = evaluation.matrix - evaluation.prior, evaluation.prior
    centre = parameters.prior_centre
    pull = data @ unknowns - (evaluation.score - evaluation.prior_score)

    def posterior(of: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Mean (n,) and covariance (n, n) of the log-moduli under a prior's precision."""
        right = np.column_stack([np.eye(len(of))[:, :n], pull + of @ centre])
        solved = linalg.solve(data + of, right, assume_a="pos", check_finite=False)
        return solved[:n, n], solved[:n, :n]

    found = dict[str, NDArray[np.float64]]()
    with determined():
        mean, covariance = posterior(prior)
        for i, block in enumerate(parameters.blocks):
            if not block.odds:
                continue
            places = parameters.columns(i)
            beliefs = _beliefs(block, places, data, prior, pull + prior @ centre)
            chosen = _present(beliefs, prior[np.ix_(places, places)])
            evidences = np.array([evidence for evidence, _ in beliefs])
            shares = np.exp(evidences - evidences.max())
            shares /= shares.sum()
            part = np.zeros((n, n))
            for k, (_, believed) in enumerate(beliefs):
                if k == chosen or shares[k] < NEGLIGIBLE:
                    continue
                other = prior.copy()
                other[np.ix_(places, places)] = linalg.inv(believed)
                moved, spread = posterior(other)
                part += shares[k] * (spread - covariance + np.outer(moved - mean, moved - mean))
            sizes, axes = np.linalg.eigh(part)  # an alternative that knows more makes nothing narrower
            found[block.cause] = found.get(block.cause, np.zeros((n, n))) + (axes * np.maximum(sizes, 0.0)) @ axes.T
    return found


def _beliefs(
    block: Block,
    places: NDArray[np.int64],
    data: NDArray[np.float64],
    prior: NDArray[np.float64],
    pull: NDArray[np.float64],
) -> list[tuple[float, NDArray[np.float64]]]:
    """Log-evidence and covariance (n, n) of each alternative of a block at its best, all others under their prior.

    data, prior: information and precision (n_unknowns, n_unknowns); pull (n_unknowns,): of data and prior means.
    """
    with determined():
        seen = _seen(data + prior, data, pull, places)
        odds = block.odds or (0.0,) * len(block.alternatives)
        return [_most_evident(terms, seen, block, odd) for terms, odd in zip(block.alternatives, odds, strict=True)]


def with_learned_prior(objective: Objective, evaluation: Evaluation, unknowns: NDArray[np.float64]) -> Objective:
    """The objective with the blocks' prior of the largest evidence around unknowns (n_unknowns,), if it is not held."""
    precision = None if objective.prior_held else learned_precision(objective, evaluation, unknowns)
    if precision is None:
        return objective
    return replace(objective, parameters=replace(objective.parameters, nuisance_precision=precision))


def with_edges(objective: Objective, evaluation: Evaluation, unknowns: NDArray[np.float64]) -> Objective:
    """The objective with a normal law for the total variation of each block that has one: to second order.

    Where, with the residuals linear around unknowns (n_unknowns,), the block's x is likeliest, block after block, the
    others following: with the gradient g and the curvature H there of minus the logarithm of what is believed, N(x -
    H^-1 g, H^-1). The minimum is that of the variation itself, and its posterior Laplace's.
    """
    parameters, n = objective.parameters, objective.n_parameters
    numbers = [i for i, block in enumerate(parameters.blocks) if block.variation]
    if not numbers:
        return objective
    prior, centre = parameters.prior_matrix, parameters.prior_centre
    data = evaluation.matrix - evaluation.prior
    pull = data @ unknowns - (evaluation.score - evaluation.prior_score)
    for i in numbers:
        places, variation = parameters.columns(i), parameters.blocks[i].variation
        assert variation is not None
        centre[places] = 0.0
        with determined():
            seen = _seen(data + prior, data, pull + prior @ centre, places)
            x = variation.least(seen.information, seen.pull, unknowns[places])
            prior[np.ix_(places, places)] = curvature = variation.curvature(x)
            centre[places] = x - linalg.solve(curvature, variation.gradient(x), assume_a="pos")
    believed = replace(parameters, nuisance_precision=prior[n:, n:], nuisance_mean=centre[n:])
    return replace(objective, parameters=believed)


def _seen(
    matrix: NDArray[np.float64], data: NDArray[np.float64], pull: NDArray[np.float64], places: NDArray[np.int64]
) -> _Seen:
    """The Schur complement of the information `data` on the unknowns `places`, the others under their prior.

    matrix (n, n): the data's and the prior's; pull (n,): likewise, with the prior's mean.
    """
    rest = np.setdiff1d(np.arange(len(pull)), places)
    across = data[np.ix_(rest, places)]
    scale = 1.0 / np.sqrt(np.maximum(np.diag(matrix)[rest], 1e-30))
    scaled = scale[:, None] * matrix[np.ix_(rest, rest)] * scale
    scaled[np.diag_indices_from(scaled)] += 1e-10  # a modulus that moves nothing
    right = scale[:, None] * np.column_stack([across, pull[rest]])
    followed = across.T @ (scale[:, None] * linalg.solve(scaled, right, assume_a="pos", check_finite=False))
    information = data[np.ix_(places, places)] - followed[:, :-1]
    return _Seen(0.5 * (information + information.T), pull[places] - followed[:, -1])


def _most_evident(
    terms: Sequence[NDArray[np.float64]], seen: _Seen, block: Block, odds: float
) -> tuple[float, NDArray[np.float64]]:
    """The largest log-evidence, with its log prior odds, of a family of priors of a block; its covariance (n, n)."""
    floored = [term + LEAST_VARIANCE * np.eye(len(term)) for term in terms]

    def worse(logs: NDArray[np.float64]) -> tuple[float, NDArray[np.float64]]:
        """Minus the log-evidence at ln of the amplitudes (n_terms,), with its derivative."""
        squares = np.exp(2.0 * logs)
        evidence, slopes = seen.log_evidence(floored, squares)
        return -evidence, -2.0 * squares * slopes

    limits = np.log(block.amplitudes)
    starts = np.log(np.where(np.eye(len(terms)) > 0.0, FIRST, ELSEWHERE)).clip(*limits)
    found = [
        optimize.minimize(worse, start, jac=True, method="L-BFGS-B", bounds=[tuple(limits)] * len(terms))
        for start in starts
    ]
    best = min(found, key=lambda trial: float(trial.fun))
    squares = np.exp(2.0 * best.x)
    return odds - float(best.fun), sum((s * t for s, t in zip(squares, floored, strict=True)), np.zeros_like(terms[0]))


def _likeliest(
    beliefs: Sequence[tuple[float, NDArray[np.float64]]], present: NDArray[np.float64]
) -> NDArray[np.float64]:
    """The covariance with the most evidence, but that of the `present` precision unless its is clearly less."""
    now, best = beliefs[_present(beliefs, present)], max(beliefs, key=lambda belief: belief[0])
    return best[1] if best[0] > now[0] + ALIKE else now[1]


def _present(beliefs: Sequence[tuple[float, NDArray[np.float64]]], precision: NDArray[np.float64]) -> int:
    """Number of the alternative that a precision (n, n) is of: the one whose covariance is as large."""
    level = -np.linalg.slogdet(precision)[1]
    return min(range(len(beliefs)), key=lambda k: abs(float(np.linalg.slogdet(beliefs[k][1])[1]) - level))


def _widest(
    beliefs: Sequence[tuple[float, NDArray[np.float64]]],
    matrix: NDArray[np.float64],
    places: NDArray[np.int64],
    n_parameters: int,
) -> NDArray[np.float64]:
    """Of covariances of a block whose evidence is as good as the best, that which leaves the widest posterior.

    matrix (n, n): the Gauss-Newton matrix without a prior on the block's `places`.
    """
    best = max(evidence for evidence, _ in beliefs)
    alike = [belief for belief in beliefs if belief[0] > best - ALIKE]
    if len(alike) == 1:
        return alike[0][1]

    def width(belief: tuple[float, NDArray[np.float64]]) -> tuple[float, float]:
        """The posterior's width under a belief, and its evidence."""
        with_it = matrix.copy()
        with_it[np.ix_(places, places)] += linalg.inv(belief[1])
        return _width(with_it, n_parameters), belief[0]

    return max(alike, key=width)[1]


def _width(matrix: NDArray[np.float64], n_parameters: int) -> float:
    """Sum of the log-moduli's posterior variances under a Gauss-Newton matrix (n, n)."""
    scale = 1.0 / np.sqrt(np.maximum(np.diag(matrix), 1e-30))
    scaled = scale[:, None] * matrix * scale
    scaled[np.diag_indices_from(scaled)] += 1e-12
    unit = np.eye(len(matrix))[:, :n_parameters]
    inverse = linalg.solve(scaled, unit, assume_a="pos", check_finite=False)
    return float(np.sum(np.diag(inverse) * scale[:n_parameters] ** 2))
