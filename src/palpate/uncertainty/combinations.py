"""What images say of several moduli together: directions of ln E by how well they are known, ratios and products."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from palpate.inversion import Bounds, Evaluation, LeastSquares, MarginalPosterior, Minimum
from palpate.uncertainty.intervals import NORMAL_95, modulus_interval


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
        parts = {"prior": float(h @ (evaluation.prior @ h))}
        for term in evaluation.linearisations:
            known = float(term.precision * term.weights @ term.jacobian.times(h[term.columns]) ** 2)
            parts[term.observation.kind] = parts.get(term.observation.kind, 0.0) + known
        found.append({kind: part / sum(parts.values()) for kind, part in parts.items()})
    return found


@dataclass(frozen=True, slots=True)
class _PairCoordinates:
    """A least-squares problem whose log-moduli i and j are ln E_i - ln E_j and (ln E_i + ln E_j) / 2 instead."""

    fixed: LeastSquares
    pair: tuple[int, int]

    @property
    def n_parameters(self) -> int:
        """Number of log-moduli among the unknowns."""
        return self.fixed.n_parameters

    def turn(self, n_unknowns: int) -> NDArray[np.float64]:
        """T (n_unknowns, n_unknowns): the unknowns x = T y of others y."""
        turn = np.eye(n_unknowns)
        turn[np.ix_(self.pair, self.pair)] = [[0.5, 1.0], [-0.5, 1.0]]
        return turn

    def __call__(self, unknowns: NDArray[np.float64]) -> Evaluation:
        """The problem's evaluation at y (n_unknowns,), with its derivatives by y."""
        turn = self.turn(len(unknowns))
        there = self.fixed(turn @ unknowns)
        shared = turn[np.ix_(*(there.matrix.places.shared,) * 2)]  # as the log-moduli are
        return replace(
            there,
            score=turn.T @ there.score,
            matrix=there.matrix.turned(shared),
            prior=there.prior.turned(shared),
            prior_score=turn.T @ there.prior_score,
        )

    def at(self, minimum: Minimum) -> Minimum:
        """A minimum's place y."""
        turned = np.linalg.solve(self.turn(len(minimum.unknowns)), minimum.unknowns)
        return replace(minimum, unknowns=np.asarray(turned, dtype=np.float64))

    def between(self, bounds: Bounds) -> Bounds:
        """The bounds of y that hold those of x."""
        (i, j), lower, upper = self.pair, bounds.lower.copy(), bounds.upper.copy()
        lower[i], upper[i] = bounds.lower[i] - bounds.upper[j], bounds.upper[i] - bounds.lower[j]
        lower[j], upper[j] = 0.5 * (bounds.lower[i] + bounds.lower[j]), 0.5 * (bounds.upper[i] + bounds.upper[j])
        return Bounds(lower, upper)


def known_pairs(
    marginal: MarginalPosterior,
    minimum: Minimum,
    names: Sequence[str],
    covariance: NDArray[np.float64],
    *,
    bounds: Bounds,
    within: float,
) -> tuple[Combination, ...]:
    """Ratios and geometric means known within a factor `within` from end to end, of pairs with a modulus that is not.

    covariance (n, n): of the log-moduli of `names`, the first unknowns of a `minimum` of M. Where the ellipse is
    so narrow, with a standard deviation of s^2 = w^T C w and weights w of (1, -1) for the ratio and (1/2, 1/2) for the
    mean, the interval is that of the combination's profile: where one of the moduli is wide, the ellipse is least true.
    Raises `SolverError` where the model cannot be solved at the minimum.
    """
    found, widest = [], np.log(within) / (2.0 * NORMAL_95)
    for i, j in combinations(range(len(names)), 2):
        if max(covariance[i, i], covariance[j, j]) <= widest**2:
            continue
        pair = _PairCoordinates(marginal.objective, (i, j))
        turned = MarginalPosterior(pair, marginal.on_moduli)
        for number, kind, weights in ((i, "ratio", [1.0, -1.0]), (j, "geometric mean", [0.5, 0.5])):
            variance = float(weights @ covariance[np.ix_([i, j], [i, j])] @ weights)
            if variance > widest**2:
                continue
            there, limits = pair.at(minimum), pair.between(bounds)
            low, high = modulus_interval(turned, there, number, variance=variance, bounds=limits).ends
            if low is not None and high is not None and high / low <= within:
                value = float(np.exp(there.unknowns[number]))
                found.append(Combination((names[i], names[j]), kind, value, (low, high)))
    return tuple(found)
