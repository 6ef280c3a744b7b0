"""What images say of several moduli together: directions of ln E by how well they are known, ratios and products."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from palpate.inversion.objective import Evaluation
from palpate.uncertainty.intervals import NORMAL_95

__all__ = ["Combination", "Information", "information", "information_shares", "known_pairs"]


@dataclass(frozen=True, slots=True)
class Information:
    """Principal axes of the covariance C of the log-moduli, the best known direction first.

    singular_values (n,): of C^(-1/2), one over the standard deviation of ln E along each of the directions (n, n), unit
    rows.
    """

    singular_values: NDArray[np.float64]
    directions: NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Combination:
    """Two moduli whose ratio, or geometric mean, is known though a single one is not.

    kind: "ratio" E_1 / E_2 or "geometric mean" (E_1 E_2)^(1/2); value, of ratios to the scale; interval95.
    """

    tissues: tuple[str, str]
    kind: str
    value: float
    interval95: tuple[float, float]

    def times(self, scale: float) -> Combination:
        """The same in another unit."""
        low, high = self.interval95
        return replace(self, value=scale * self.value, interval95=(scale * low, scale * high))


def information(covariance: NDArray[np.float64]) -> Information:
    """The directions of a covariance (n, n) of log-moduli."""
    variances, axes = np.linalg.eigh(covariance)
    signs = np.sign(axes[np.abs(axes).argmax(axis=0), np.arange(len(axes))])
    return Information(1.0 / np.sqrt(variances), (axes * signs).T)


def information_shares(evaluation: Evaluation, n_parameters: int) -> list[dict[str, float]]:
    """Of each of n parameters, the share of each kind of data in what is known of it, 0 to 1, and of what was believed.

    With h = H^-1 e_i its precision is the sum of h^T J_k^T W_k J_k h / h^T H h over the kinds, and of the prior's part.
    """
    found = []
    for h in evaluation.covariance_columns(n_parameters).T:
        parts = {"prior": float(h @ evaluation.prior @ h)}
        for line in evaluation.lines:
            known = float(line.precision * line.weights @ line.jacobian.times(h[line.columns]) ** 2)
            parts[line.observation.kind] = parts.get(line.observation.kind, 0.0) + known
        found.append({kind: part / sum(parts.values()) for kind, part in parts.items()})
    return found


def known_pairs(
    names: Sequence[str], theta: NDArray[np.float64], covariance: NDArray[np.float64], *, within: float
) -> tuple[Combination, ...]:
    """Ratios and geometric means known within a factor `within` from end to end, of pairs with a modulus that is not.

    theta (n,), covariance (n, n): of the log-moduli of `names`. The factor is exp(2 1.96 s), s^2 = w^T C w with weights
    w of (1, -1) for the ratio and (1/2, 1/2) for the mean.
    """
    found, widest = [], np.log(within) / (2.0 * NORMAL_95)
    for i, j in combinations(range(len(names)), 2):
        if max(covariance[i, i], covariance[j, j]) <= widest**2:
            continue
        for kind, weights in (("ratio", np.array([1.0, -1.0])), ("geometric mean", np.array([0.5, 0.5]))):
            sd = float(np.sqrt(weights @ covariance[np.ix_([i, j], [i, j])] @ weights))
            if sd <= widest:
                middle = float(weights @ theta[[i, j]])
                low, high = (float(np.exp(middle + sign * NORMAL_95 * sd)) for sign in (-1.0, 1.0))
                found.append(Combination((names[i], names[j]), kind, float(np.exp(middle)), (low, high)))
    return tuple(found)
