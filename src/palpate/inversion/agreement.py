"""Weights and estimate in turn until they agree: what an estimate is must not depend on the way to it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from palpate.inversion.gauss_newton import Minimum
from palpate.inversion.minima import change_between, continued, moved_between, posterior_sd
from palpate.inversion.noise import NoiseLaw
from palpate.inversion.objective import Objective
from palpate.inversion.problem import InverseProblem, InversionSettings
from palpate.inversion.weighting import weighed_anew

__all__ = ["AGREED", "PASSES", "Agreement", "agreed", "left_since"]

AGREED = 3e-4  # of ln E: what is left undone
PASSES = 15
LEAST_SD = 0.03  # of ln E: a distance of a per cent from exact derivatives leaves `AGREED` then


@dataclass(frozen=True, slots=True)
class Agreement:
    """A minimum under the objective whose weights, and the `law` behind them, are those of the pass before.

    change: of ln E, at the most, by the last pass; moved: the same in posterior standard deviations.
    """

    law: NoiseLaw
    objective: Objective
    minimum: Minimum
    change: float
    moved: float


def agreed(
    problem: InverseProblem,
    objective: Objective,
    minimum: Minimum,
    settings: InversionSettings,
    *,
    within: float = AGREED,
    passes: int = PASSES,
) -> Agreement:
    """Law of the residuals, drivers' prior, weights and estimate in turn on the same models, from a point.

    It ends when a pass changes the log-moduli by less than `within`, or after so many `passes`; each minimum is found
    to a sixth of that.
    """
    for _ in range(passes):
        law, objective = weighed_anew(problem, objective, minimum, settings.law)
        before, minimum = minimum, continued(objective, minimum, settings, still=within / 6.0)
        change = float(change_between(before, minimum, objective.n_parameters).max(initial=0.0))
        if change < within:
            break
    return Agreement(law, objective, minimum, change, moved_between(before, minimum, objective.n_parameters))


def left_since(sharp: NDArray[np.float64] | None, there: Minimum, n_parameters: int) -> float:
    """How far derivatives that are exact at log-moduli `sharp` (n_parameters,) may set an estimate off, of ln E.

    At a distance d of ln E they are off by a share d, and so is what the residuals pull with them, which is worth a
    posterior standard deviation: d sd, the largest of all log-moduli; infinite where they are exact nowhere (None). A
    standard deviation counts as 0.03 at least: its own error is a share d, too, and may be a per cent.
    """
    if sharp is None:
        return np.inf
    distance = np.abs(there.unknowns[:n_parameters] - sharp)
    return float(np.max(distance * np.maximum(posterior_sd(there, n_parameters), LEAST_SD), initial=0.0))
