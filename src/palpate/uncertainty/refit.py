"""Hyper-parameters and an estimate that agree with given residuals, with closest points and the approximation held.

A change of the residuals also changes what they say of their noise, of outliers and of the drivers' motion. That moves
an estimate to first order, too: with the hyper-parameters held it would be foretold too small.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from palpate.inversion import (
    Bounds,
    FixedCorrespondence,
    LinearisedObjective,
    Minimum,
    Objective,
    Outcome,
    fixed_correspondence,
    gauss_newton,
    posterior_sd,
    with_correlations,
    with_hyper_parameters,
)

__all__ = ["refitted"]

PASSES = 10
SETTLED = 0.02  # posterior standard deviations, as the outer loop's own
TOLERANCE = 1e-6  # decrement of a minimum


def refitted(
    objective: Objective, minimum: Minimum, bounds: Bounds, *, max_steps: int = 40
) -> tuple[Minimum, FixedCorrespondence]:
    """The estimate that the residuals in a `minimum`'s evaluation lead to, and what it is the minimum of.

    Hyper-parameters and unknowns in turn, until no log-modulus moves by 0.02 of its standard deviation, ten times at
    the most: where it still does, the minimum has the outcome `STEPS`. No model is solved. Raises `EstimationError`
    where the residuals leave an unknown open, `SolverError` where the approximation has no answer.
    """
    n, now = objective.n_parameters, minimum
    objective = with_correlations(objective, now.evaluation)
    for _ in range(PASSES):
        here = LinearisedObjective(objective, now.unknowns, now.evaluation)(now.unknowns)
        objective = with_hyper_parameters(objective, here, now.unknowns)
        weighed = LinearisedObjective(objective, now.unknowns, now.evaluation)(now.unknowns)
        fixed = fixed_correspondence(objective, now.unknowns, weighed)
        before, now = now, gauss_newton(fixed, now.unknowns, bounds=bounds, tolerance=TOLERANCE, max_steps=max_steps)
        if np.all(np.abs(now.unknowns - before.unknowns)[:n] < SETTLED * posterior_sd(now, n)):
            return now, fixed
    return (replace(now, outcome=Outcome.STEPS) if now.converged else now), fixed
