"""What every image pair of a joint estimate says alone: whether they agree, which one does not, how they scatter."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy import special

from palpate.inversion import Bounds, Minimum, Objective, gauss_newton
from palpate.uncertainty.covariance import sandwich_covariance
from palpate.uncertainty.profile import fixed_correspondence
from palpate.uncertainty.repeatability import within_subject_cv

__all__ = ["Agreement", "PairEstimate", "agreement", "pair_estimates"]

OUTLIER = 0.01  # probability, over all pairs together, of calling one an outlier that is none
LEAST_PAIRS = 3  # of two that differ nobody can say which is wrong


@dataclass(frozen=True, slots=True)
class PairEstimate:
    """Log-moduli theta (n,) with covariance (n, n) from one later image alone; converged: whether it has a minimum."""

    theta: NDArray[np.float64]
    covariance: NDArray[np.float64]
    converged: bool


@dataclass(frozen=True, slots=True)
class Agreement:
    """How the pairs of one patient agree.

    outlier (n_pairs,): pairs that the others contradict; influence (n_pairs, n): by how many of its standard deviations
    the weighted mean of all moves when a pair is left out; heterogeneity: probability of so large differences if all
    pairs had the same moduli, of those that are no outliers; within_cv (n,): within-subject coefficient of variation
    of each modulus, of the same; theta (n,), covariance (n, n): their random-effects mean.
    """

    outlier: NDArray[np.bool_]
    influence: NDArray[np.float64]
    heterogeneity: float
    within_cv: NDArray[np.float64]
    theta: NDArray[np.float64]
    covariance: NDArray[np.float64]


def pair_estimates(objective: Objective, minimum: Minimum, bounds: Bounds) -> tuple[PairEstimate, ...]:
    """The estimate of each later state alone, near the joint `minimum`: with its closest points, weights and prior.

    Nothing is solved; the approximations of the joint estimate stand. Raises `EstimationError` where a state alone
    leaves a driver's motion open.
    """
    n, estimates = objective.n_parameters, []
    for s, state in enumerate(objective.states):
        parameters, own = objective.parameters.alone(s)
        alone = Objective((state,), parameters)
        seen = [line for line in minimum.evaluation.lines if line.state == s]
        lines = tuple(replace(line, state=0, columns=np.searchsorted(own, line.columns)) for line in seen)
        start = minimum.unknowns[own]
        fixed = fixed_correspondence(alone, start, replace(minimum.evaluation, lines=lines))
        found = gauss_newton(fixed, start, bounds=bounds, tolerance=1e-4)
        covariance = sandwich_covariance(alone, found.evaluation)
        estimates.append(PairEstimate(found.unknowns[:n], covariance, found.converged))
    return tuple(estimates)


def agreement(pairs: Sequence[PairEstimate]) -> Agreement:
    """Outliers, influence, heterogeneity and repeatability of two or more pairs.

    A pair is an outlier when its squared Mahalanobis distance from the weighted mean of the others exceeds the
    chi-squared quantile of 1 - 0.01 / n_pairs; the worst one goes first, then the rest is asked again, down to two.
    Heterogeneity: Cochran's Q = sum_p (t_p - t)^T V_p^-1 (t_p - t) against chi-squared with (n_pairs - 1) n degrees of
    freedom. The mean's covariance is widened by the variance between pairs (DerSimonian & Laird, Controlled Clinical
    Trials 7 (1986) 177-188, here for each modulus). Within-subject variation: `within_subject_cv` of ln E over pairs.
    """
    theta, covariance = np.stack([p.theta for p in pairs]), np.stack([p.covariance for p in pairs])
    kept = np.ones(len(pairs), dtype=bool)
    limit = special.chdtri(theta.shape[1], OUTLIER / len(pairs))
    while kept.sum() >= LEAST_PAIRS:
        distances = np.array([_distance(theta, covariance, kept, p) if kept[p] else 0.0 for p in range(len(pairs))])
        if distances.max() <= limit:
            break
        kept[int(distances.argmax())] = False
    mean, spread = _mean(theta, covariance, np.ones(len(pairs), dtype=bool))
    influence = np.stack([(mean - _mean(theta, covariance, _without(p, len(pairs)))[0]) for p in range(len(pairs))])
    good, own = theta[kept], covariance[kept]
    centre, _ = _mean(theta, covariance, kept)
    away = good - centre
    q = float(np.einsum("pi,pij,pj->", away, np.linalg.inv(own), away))
    between = _between(good, own)
    robust, robust_covariance = _mean(good, own + np.diag(between), np.ones(len(good), dtype=bool))
    return Agreement(
        outlier=~kept,
        influence=influence / np.sqrt(np.diag(spread)),
        heterogeneity=float(special.chdtrc(max(good.size - good.shape[1], 1), q)),
        within_cv=within_subject_cv(np.var(good, axis=0, ddof=1)),
        theta=robust,
        covariance=robust_covariance,
    )


def _mean(
    theta: NDArray[np.float64], covariance: NDArray[np.float64], kept: NDArray[np.bool_]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Weighted mean (n,) of theta (n_pairs, n) by the inverse of their covariances, and its own, of the pairs kept."""
    precisions = np.linalg.inv(covariance[kept])
    spread = np.linalg.inv(precisions.sum(axis=0))
    return np.asarray(spread @ np.einsum("pij,pj->i", precisions, theta[kept])), np.asarray(spread)


def _distance(theta: NDArray[np.float64], covariance: NDArray[np.float64], kept: NDArray[np.bool_], pair: int) -> float:
    """Squared Mahalanobis distance of a pair from the weighted mean of the others that are kept."""
    mean, spread = _mean(theta, covariance, kept & _without(pair, len(theta)))
    away = theta[pair] - mean
    return float(away @ np.linalg.solve(covariance[pair] + spread, away))


def _without(pair: int, n_pairs: int) -> NDArray[np.bool_]:
    return np.asarray(np.arange(n_pairs) != pair)


def _between(theta: NDArray[np.float64], covariance: NDArray[np.float64]) -> NDArray[np.float64]:
    """Variance (n,) between pairs of each log-modulus, by the method of moments; none below zero."""
    weights = 1.0 / np.diagonal(covariance, axis1=1, axis2=2)
    total = weights.sum(axis=0)
    mean = (weights * theta).sum(axis=0) / total
    q = (weights * (theta - mean) ** 2).sum(axis=0)
    scale = total - (weights**2).sum(axis=0) / total
    return np.asarray(np.maximum((q - (len(theta) - 1)) / scale, 0.0))
