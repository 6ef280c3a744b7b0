"""The covariance that is missing where the data did not decide between alternative priors."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from palpate.approximation.contract import determined
from palpate.inversion.by_image import solve_by_image
from palpate.inversion.hyper_parameters import NormalModel, normal_model
from palpate.inversion.objective import Evaluation, Objective


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
    model = normal_model(parameters, evaluation, unknowns)

    def posterior(of: NormalModel) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Mean (n,) and covariance (n, n) of the log-moduli under a prior."""
        right = np.column_stack([np.eye(len(of.pull))[:, :n], of.pull])
        found = solve_by_image(of.data + of.prior, right, evaluation.images)
        return found[:n, n], found[:n, :n]

    found = dict[str, NDArray[np.float64]]()
    numbers = objective.chosen or (None,) * len(parameters.blocks)
    with determined():
        mean, covariance = posterior(model)
        for i in range(len(parameters.blocks)):
            block, chosen = parameters.blocks[i], numbers[i] or 0
            if not block.odds:
                continue
            beliefs = model.beliefs(i, numbers)
            evidences = np.array([belief.evidence for belief in beliefs])
            shares = np.exp(evidences - evidences.max())
            shares /= shares.sum()
            part = np.zeros((n, n))
            for k, belief in enumerate(beliefs):
                if k == chosen:
                    continue
                moved, spread = posterior(model.believing(i, belief.covariance))
                part += shares[k] * (spread - covariance + np.outer(moved - mean, moved - mean))
            sizes, axes = np.linalg.eigh(part)  # an alternative that knows more makes nothing narrower
            found[block.cause] = found.get(block.cause, np.zeros((n, n))) + (axes * np.maximum(sizes, 0.0)) @ axes.T
    return found
