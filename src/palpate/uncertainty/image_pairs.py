"""What every image pair of a joint estimate says alone: whether they agree, which one does not, how they scatter.

Pairs of one patient are not independent: later images that share a rest image share its drawing and its mesh, and all
share the prior of what they have in common. So their estimates have one covariance, and one that is joint.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy import special

from palpate.inversion import (
    Bounds,
    FrozenPosterior,
    MarginalPosterior,
    Minimum,
    Objective,
    Posterior,
    fixed_correspondence,
)
from palpate.observation.noise_model import NoiseModel
from palpate.uncertainty.covariance import (
    GridErrors,
    error_noise,
    gain,
    grid_covariance,
    mesh_covariance,
    noise_covariance,
    scatter,
    shifts_by,
)
from palpate.uncertainty.intervals import NORMAL_95, within_subject_cv
from palpate.unknowns import Choice

OUTLIER = 0.01  # probability of a false outlier among all pairs
MOST_OUTLIERS = 4  # at most one pair of four is an outlier; where more differ, the pairs vary and none is wrong
LEAST_PAIRS = 3  # of two pairs that differ, either may be wrong
BETWEEN_GRIDS = 0.5  # factor on the covariance of two pairs from few draws, which keeps the whole positive


@dataclass(frozen=True, slots=True)
class PairEstimates:
    """Log-moduli theta (n_pairs, n) from each later image alone, and whether each has a minimum, converged (n_pairs,).

    covariance (n_pairs, n, n_pairs, n): of all of them together.
    """

    theta: NDArray[np.float64]
    covariance: NDArray[np.float64]
    converged: NDArray[np.bool_]

    def of(self, pairs: NDArray[np.bool_]) -> PairEstimates:
        """Those of some pairs (n_pairs,)."""
        return PairEstimates(self.theta[pairs], self.covariance[pairs][:, :, pairs], self.converged[pairs])


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


def pair_estimates(
    objective: Objective, minimum: Minimum, bounds: Bounds, errors: GridErrors, frozen: Posterior | None = None
) -> PairEstimates:
    """The estimate of each later state alone, near the joint `minimum`: with its closest points, weights and prior.

    The covariance has parts by noise and prior, by blocks that are held, by the place of the grid (see
    `grid_covariance`), and by the mesh, which those of one reference share.
    errors: of the residuals on random grids (see `grid_errors`); frozen: the posterior, where it is known as a frozen
    one. Nothing is solved; the approximations of the joint estimate stand. Raises `EstimationError` where a state alone
    leaves a driver's motion open.
    """
    alone = _each_alone(objective, minimum, bounds, frozen)
    noise, prior = _noise_and_prior(objective, alone)
    n, n_pairs, mapping = objective.n_parameters, len(alone), objective.parameters
    held = np.zeros((mapping.n_unknowns, n * n_pairs))  # J_b^T W J H_s^-1 e_i
    shifts, mesh = list[NDArray[np.float64]](), np.zeros((n_pairs, n, n_pairs, n))
    references = [state.reference for state in objective.states]
    states = [s for s, state in enumerate(objective.states) for _ in state.observations]  # of each observation
    for s, evaluation in enumerate(of.evaluation for of in alone):
        of_data = evaluation.matrix - evaluation.prior
        held[mapping.alone(s)[1], s * n : (s + 1) * n] = of_data @ evaluation.covariance_columns(n)
        seen = [i for i, state in enumerate(states) if state == s]
        shifts.append(shifts_by(gain(evaluation, n), [[draw[i] for i in seen] for draw in errors]))
        of_mesh = mesh_covariance(replace(objective, states=(objective.states[s],)))
        for t in range(n_pairs):
            mesh[s, :, t] += of_mesh if references[s] == references[t] else 0.0
    total = noise + prior
    for i, block in enumerate(mapping.blocks):
        if block.choice is Choice.HELD:
            of_block = held[mapping.columns(i)]
            total += of_block.T @ block.widest @ of_block
    itself = np.kron(np.eye(n_pairs), np.ones((n, n)))
    grid = scatter(np.concatenate(shifts, axis=1)) * (BETWEEN_GRIDS + (1.0 - BETWEEN_GRIDS) * itself)
    covariance = (total + grid_covariance(alone[0].evaluation, grid, noise)).reshape(mesh.shape) + mesh
    theta = np.stack([of.unknowns[:n] for of in alone])
    return PairEstimates(theta, covariance, np.array([of.converged for of in alone]))


def _each_alone(objective: Objective, minimum: Minimum, bounds: Bounds, frozen: Posterior | None) -> list[Minimum]:
    """The minimum of M of each later state alone, its unknowns those of `ParameterMap.alone`.

    Where its posterior is frozen, that is where it is sought; its residuals are then evaluated once.
    """
    found = list[Minimum]()
    for s, state in enumerate(objective.states):
        parameters, own = objective.parameters.alone(s)
        seen = [term for term in minimum.evaluation.linearisations if term.state == s]
        linearisations = tuple(replace(term, state=0, columns=np.searchsorted(own, term.columns)) for term in seen)
        start = minimum.unknowns[own]
        evaluation = replace(minimum.evaluation, linearisations=linearisations)
        fixed = fixed_correspondence(Objective((state,), parameters), start, evaluation)
        alone = frozen.alone(s) if isinstance(frozen, FrozenPosterior) else fixed
        least = MarginalPosterior.of(alone).minimum(start, bounds).minimum
        found.append(least if alone is fixed else replace(least, evaluation=fixed(least.unknowns)))
    return found


def _noise_and_prior(objective: Objective, alone: Sequence[Minimum]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Covariances (n_pairs n, n_pairs n) of the estimates of each state alone by noise, and by the prior.

    G_s is the gain of the residuals and H_s the Gauss-Newton matrix of a state s. By noise it is G_s C_st G_t^T. Half
    of the noise is the rest image's, which states of one reference share, unless its drawing is an unknown. By the
    prior it is H_s^-1 P_st H_t^-1, where common unknowns count once.
    """
    n, mapping = objective.n_parameters, objective.parameters
    size, pairs, noise = n * len(alone), [], dict[tuple[int, str], NoiseModel]()
    answers = np.zeros((mapping.n_unknowns, size))  # H_s^-1 e_i, side by side
    for s, evaluation in enumerate(of.evaluation for of in alone):
        columns = slice(s * n, (s + 1) * n)
        answers[mapping.alone(s)[1], columns] = evaluation.covariance_columns(n)
        noise |= {(s, kind): model for (_, kind), model in error_noise(evaluation).items()}
        for term, rows in zip(evaluation.linearisations, gain(evaluation, n), strict=True):
            placed = np.zeros((size, rows.shape[1]))
            placed[columns] = rows
            pairs.append((replace(term, state=s), placed))
    return noise_covariance(objective, pairs, noise), np.asarray(answers.T @ (mapping.prior_of_blocks @ answers))


def agreement(pairs: PairEstimates) -> Agreement:
    """Outliers, influence, heterogeneity and repeatability of two or more pairs.

    The mean is that of generalised least squares under the covariance V of all pairs together. A pair is an outlier
    when its squared Mahalanobis distance from the mean of the others exceeds the chi-squared quantile of
    1 - 0.01 / n_pairs; the worst one goes first, then the rest is asked again, down to two; where more than a quarter
    of them (one at the least) would go, none does. Heterogeneity: Cochran's Q, (t - A m)^T V^-1 (t - A m), against
    chi-squared with (n_pairs - 1) n degrees of freedom. The mean's covariance is widened by the variance between pairs
    (DerSimonian & Laird, Controlled Clinical Trials 7 (1986) 177-188, here for each modulus and with V) and, where
    there is one, so that 1.96 standard deviations reach as far as Student's quantile of so few pairs (Hartung & Knapp,
    Stat. Med. 20 (2001) 1771-1782). Within-subject variation: `within_subject_cv` of ln E over pairs.
    """
    n_pairs, n = pairs.theta.shape
    theta, joint = pairs.theta.ravel(), pairs.covariance.reshape(n_pairs * n, n_pairs * n)
    every, kept = np.ones(n_pairs, dtype=bool), np.ones(n_pairs, dtype=bool)
    limit = special.chdtri(n, OUTLIER / n_pairs)
    while kept.sum() >= LEAST_PAIRS:
        distances = np.zeros(n_pairs)
        for p in np.flatnonzero(kept).tolist():
            away = -_mean(joint, kept & _without(p, n_pairs))[0]
            away[:, p * n : (p + 1) * n] += np.eye(n)
            off = away @ theta
            distances[p] = off @ np.linalg.solve(away @ joint @ away.T, off)
        if distances.max() <= limit:
            break
        kept[int(distances.argmax())] = False
    if np.count_nonzero(~kept) > max(n_pairs // MOST_OUTLIERS, 1):
        kept = every
    weights, spread = _mean(joint, every)
    without = [_mean(joint, every & _without(p, n_pairs))[0] @ theta for p in range(n_pairs)]
    good = pairs.of(kept)
    between = np.zeros(n)
    for i in range(n):  # Q of one modulus has the mean n_pairs - 1 + variance tr P
        about = _about_the_mean(good.covariance[:, i, :, i], np.ones((len(good.theta), 1)))
        q = float(good.theta[:, i] @ about @ good.theta[:, i])
        between[i] = max((q - (len(good.theta) - 1)) / float(np.trace(about)), 0.0)
    about = _about_the_mean(good.covariance.reshape(good.theta.size, -1), np.tile(np.eye(n), (len(good.theta), 1)))
    q = float(good.theta.ravel() @ about @ good.theta.ravel())
    robust, covariance = _mean(joint + np.diag(np.tile(between, n_pairs)), kept)
    few = np.where(between > 0.0, special.stdtrit(len(good.theta) - 1, special.ndtr(NORMAL_95)) / NORMAL_95, 1.0)
    return Agreement(
        outlier=~kept,
        influence=(weights @ theta - np.stack(without)) / np.sqrt(np.diag(spread)),
        heterogeneity=float(special.chdtrc(max(good.theta.size - n, 1), q)),
        within_cv=within_subject_cv(np.var(good.theta, axis=0, ddof=1)),
        theta=robust @ theta,
        covariance=covariance * np.outer(few, few),
    )


def _mean(joint: NDArray[np.float64], kept: NDArray[np.bool_]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Weights (n, n_pairs n) of the generalised least squares mean of the pairs that are kept, its covariance (n, n).

    joint (n_pairs n, n_pairs n): covariance of all pairs together.
    """
    n = len(joint) // len(kept)
    rows = np.repeat(kept, n)
    design = np.tile(np.eye(n), (int(kept.sum()), 1))
    pulled = np.linalg.solve(joint[np.ix_(rows, rows)], design).T
    spread = np.asarray(np.linalg.inv(pulled @ design), dtype=np.float64)
    weights = np.zeros((n, len(joint)))
    weights[:, rows] = spread @ pulled
    return weights, spread


def _about_the_mean(joint: NDArray[np.float64], design: NDArray[np.float64]) -> NDArray[np.float64]:
    """P (k, k) of Q = t^T P t, the squared Mahalanobis distance of estimates t (k,) from their mean.

    joint (k, k): their covariance V; design (k, n): A, which of n log-moduli each is; P = V^-1 - V^-1 A (A^T V^-1 A)^-1
    A^T V^-1.
    """
    pulled = np.linalg.solve(joint, design)
    return np.asarray(np.linalg.inv(joint) - pulled @ np.linalg.solve(design.T @ pulled, pulled.T))


def _without(pair: int, n_pairs: int) -> NDArray[np.bool_]:
    return np.asarray(np.arange(n_pairs) != pair)
