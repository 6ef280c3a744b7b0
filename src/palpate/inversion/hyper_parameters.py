"""The hyper-parameters of the objective: how large the residuals' noise is, and how far each block may move.

All are steps on one function (see `Objective`), the residuals linear around the present unknowns. A wall that moves by
3 mm as one piece must not be allowed to slide by 5 mm on its own: nothing in the images holds it back along itself, and
the moduli then pay for it. A frame that stands still must not move, a homogeneous tissue not be patchy.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import linalg, optimize

from palpate.approximation.contract import determined
from palpate.inversion.objective import AS_GOOD, Evaluation, Linearisation, Objective, worse_driver
from palpate.observation.contract import Observation
from palpate.observation.noise_model import NoiseModel
from palpate.unknowns.blocks import Acts, Block
from palpate.unknowns.parameters import ParameterMap

LEAST_VARIANCE = 1e-3  # of a motion's coefficient, in its unit, so that no mode is excluded
FITTED = 0.5  # largest share of a kind's residuals that counts as fitted by the unknowns

LogEvidence = Callable[[NDArray[np.float64]], tuple[float, NDArray[np.float64]]]
"""A log-evidence F and dF / d v_t (n_terms,) at the variances v_t (n_terms,) of a prior's terms."""


def with_first_noise(objective: Objective) -> Objective:
    """The objective before any residual is seen: all count by the noise that each kind begins with in its image."""
    seen = [(s, o, state.observations) for s, state in enumerate(objective.states) for o in state.observations]
    noise = {(s, o.kind): o.first_noise([p for p in peers if p.kind == o.kind]) for s, o, peers in seen}
    return _of_each(objective, lambda s, o: o.with_noise(noise[s, o.kind]))


def with_correlations(objective: Objective, evaluation: Evaluation) -> Objective:
    """The objective with the numbers of independent residuals that those of an evaluation tell; their scales stay."""
    noise = fitted_noise(evaluation)
    return _of_each(objective, lambda s, o: o.with_correlation(noise[s, o.kind]))


def with_hyper_parameters(objective: Objective, evaluation: Evaluation, unknowns: NDArray[np.float64]) -> Objective:
    """A step of the hyper-parameters at unknowns (n_unknowns,), the residuals linear around their evaluation.

    Raises `EstimationError` where the images do not determine a block's motion.
    """
    learned = with_amplitudes(with_scales(objective, evaluation), evaluation, unknowns)
    return with_edges(learned, evaluation, unknowns)


def with_scales(objective: Objective, evaluation: Evaluation) -> Objective:
    """The scales s with the least objective, one of each kind and later image, and of a driver no smaller one.

    d/d ln s of 1/2 ln det H is -g, g = tr H^-1 J^T W J the number of unknowns that the residuals determine (MacKay
    1992): s^2 = n rho / (n - g) of a mean square rho where no outlier is.
    """
    linearisations, found, inverse = evaluation.linearisations, dict[int, float](), np.zeros_like(evaluation.matrix)
    matrix = evaluation.matrix - evaluation.prior + objective.as_normal(evaluation)[0]
    seen = np.flatnonzero(np.diag(matrix) > 0.0)
    with determined():
        inverse[np.ix_(seen, seen)] = np.linalg.inv(matrix[np.ix_(seen, seen)])
    for own, telling in of_one_noise(evaluation).values():
        pooled = _scale([linearisations[i] for i in telling], inverse, 0.0)
        apart = [i for i in own if i not in telling]
        found |= dict.fromkeys(own, pooled) | {i: _scale([linearisations[i]], inverse, pooled) for i in apart}
    pairs = enumerate(objective.observations)
    return objective.with_observations([o.with_sd(found[i]) for i, o in pairs])


def _scale(linearisations: Sequence[Linearisation], inverse: NDArray[np.float64], least: float) -> float:
    """The scale (mm) of some observations' residuals, at least `least`; inverse (n, n): H^-1."""
    count = sum(term.observation.weighting.count for term in linearisations)
    determine = 0.0
    for term in linearisations:
        determine += float(np.sum(inverse[np.ix_(term.columns, term.columns)] * term.information))
    low = max(least, *(term.observation.sd_bounds[0] for term in linearisations))
    high = min(term.observation.sd_bounds[1] for term in linearisations)
    if high <= low:
        return low
    determine = min(determine, FITTED * count)

    def worse(log_sd: float) -> float:
        """The part of the objective that depends on ln s."""
        total = -determine * log_sd
        for term in linearisations:
            weighting = term.observation.with_sd(float(np.exp(log_sd))).weighting
            rho = float(term.residuals.weights @ weighting.loss.rho(term.residuals.values))
            total += 0.5 * weighting.precision * rho + weighting.log_normaliser
        return total if least == 0.0 else total + worse_driver(float(np.exp(log_sd)), least)

    now = float(np.log(linearisations[0].observation.weighting.sd))
    ends = (max(np.log(low), now - 4.0), min(np.log(high), now + 4.0))
    if ends[1] <= ends[0]:
        return float(np.clip(np.exp(now), low, high))
    best = optimize.minimize_scalar(worse, bounds=ends, method="bounded", options={"xatol": 1e-5})
    return float(np.exp(best.x)) if best.fun < worse(ends[0]) else float(np.exp(ends[0]))


def fitted_noise(evaluation: Evaluation) -> dict[tuple[int, str], NoiseModel]:
    """Noise model by later state and kind of observation, of the residuals that tell (see `of_one_noise`).

    Each later image has its own: one that was drawn badly would else take from what the others are believed.
    """
    linearisations, groups = evaluation.linearisations, of_one_noise(evaluation)
    telling = {key: [linearisations[i] for i in those] for key, (_, those) in groups.items()}
    return {key: of[0].observation.fitted_noise([each.residuals for each in of]) for key, of in telling.items()}


def of_one_noise(evaluation: Evaluation) -> dict[tuple[int, str], tuple[list[int], list[int]]]:
    """Numbers of the observations of each later state and kind, which share a noise model; of those that tell of it.

    Modes flatten a driver's residuals: they tell where nothing else is seen.
    """
    groups: dict[tuple[int, str], tuple[list[int], list[int]]] = {}
    for i, term in enumerate(evaluation.linearisations):
        own, telling = groups.setdefault((term.state, term.observation.kind), ([], []))
        own.append(i)
        telling += [] if term.observation.of_driver else [i]
    return {key: (own, telling or own) for key, (own, telling) in groups.items()}


def _of_each(objective: Objective, change: Callable[[int, Observation], Observation]) -> Objective:
    return objective.with_observations(
        [change(s, o) for s, state in enumerate(objective.states) for o in state.observations]
    )


@dataclass(frozen=True, slots=True)
class _Whitened:
    """Root R (r, n) and target t (r,), dimensionless, of an information A = R^T R and a pull b = R^T t."""

    root: NDArray[np.float64]
    target: NDArray[np.float64]

    @classmethod
    def of(cls, information: NDArray[np.float64], pull: NDArray[np.float64]) -> _Whitened:
        """Root and target along the eigenvectors of A; those by rounding alone are left out, but never all."""
        sizes, vectors = linalg.eigh(information, check_finite=False)
        number = np.finfo(np.float64)
        kept = sizes > len(sizes) * number.eps * sizes[-1]
        kept[-1] = True
        roots, axes = np.sqrt(np.maximum(sizes[kept], number.tiny)), vectors[:, kept].T
        return cls(roots[:, None] * axes, axes @ pull / roots)

    def log_evidence(self, terms: Sequence[NDArray[np.float64]]) -> LogEvidence:
        """F = 1/2 (b^T (A + C^-1)^-1 b - ln det(1 + C A)) of C = sum_t v_t C_t, C_t (n, n) the terms of a prior.

        With D_t = R C_t R^T, K = sum_t v_t D_t and w = (1 + K)^-1 t it is 1/2 (w^T K t - ln det(1 + K)), its
        derivatives dF / d v_t = 1/2 (w^T D_t w - tr (1 + K)^-1 D_t). A single D_t is made diagonal once for all v.
        """
        target, seen = self.target, np.stack([self.root @ term @ self.root.T for term in terms])
        if len(seen) == 1:
            sizes, axes = linalg.eigh(seen[0], check_finite=False)
            sizes, squares = np.maximum(sizes, 0.0), (axes.T @ target) ** 2

            def of_one(variances: NDArray[np.float64]) -> tuple[float, NDArray[np.float64]]:
                """F and dF / dv (1,) at a variance (1,)."""
                grown = 1.0 + variances[0] * sizes
                value = 0.5 * float(np.sum(variances[0] * sizes * squares / grown - np.log(grown)))
                return value, np.array([0.5 * float(np.sum(sizes * (squares / grown - 1.0) / grown))])

            return of_one

        def of_several(variances: NDArray[np.float64]) -> tuple[float, NDArray[np.float64]]:
            """F and dF / dv (n_terms,) at variances (n_terms,)."""
            moved = np.tensordot(variances, seen, axes=1)
            factor = linalg.cholesky(np.eye(len(target)) + moved, lower=True, overwrite_a=True, check_finite=False)
            at_best = linalg.cho_solve((factor, True), target, check_finite=False)
            determinant = 2.0 * float(np.sum(np.log(np.diag(factor))))
            inverse, _ = linalg.lapack.dpotri(factor, lower=1, overwrite_c=1)  # its lower triangle
            traces = 2.0 * np.einsum("tij,ij->t", seen, inverse) - np.einsum("tii,ii->t", seen, inverse)
            slopes = 0.5 * (np.einsum("i,tij,j->t", at_best, seen, at_best, optimize=True) - traces)
            return 0.5 * (float(at_best @ moved @ target) - determinant), slopes

        return of_several


def with_amplitudes(objective: Objective, evaluation: Evaluation, unknowns: NDArray[np.float64]) -> Objective:
    """The objective with the blocks' alternatives and amplitudes of the largest evidence, block after block.

    With A = J^T W J and b = A x - J^T W r at unknowns x (n_unknowns,) the log-evidence of P is 1/2 (b^T (A + P)^-1 b -
    ln det(A + P) + ln det P) up to a constant (MacKay 1992, Neural Computation 4, 415-447, section 4), the other blocks
    under their present prior. An alternative stays until another one is more than as good; of a material the first one.
    Of blocks that are learned last the one that gains most has its choice first: the first of them would else take what
    another one explains better. Where these have their choice, too, a slight second alternative of a block is judged
    against its first by what rivals gain beside each, for what either explains as well would else be this block's.
    """
    parameters, n = objective.parameters, objective.n_parameters
    chosen = list(objective.chosen or (None,) * len(parameters.blocks))
    model, prior = normal_model(parameters, evaluation, unknowns), evaluation.prior.copy()

    def choice(i: int) -> tuple[float, int, Belief]:
        """The gain of a block's best alternative, the number of the one it takes, and that one's covariance."""
        block, beliefs = parameters.blocks[i], model.beliefs(i, chosen, prior)
        best = max(range(len(beliefs)), key=lambda k: beliefs[k].evidence)
        present = chosen[i] if chosen[i] in range(len(beliefs)) else None
        if present is None and block.acts is Acts.MATERIAL:
            present = 0
        if present is None and objective.learn_last and block.slight and best == 1:
            beliefs, present = model.beliefs_beside(i, chosen, prior)[:2], 0
        if present is None:
            return np.inf, best, beliefs[best]
        gain = beliefs[best].evidence - beliefs[present].evidence
        taken = best if gain > AS_GOOD else present
        return gain, taken, beliefs[taken]

    learned = [i for i, block in enumerate(parameters.blocks) if block.alternatives]
    last = [i for i in learned if parameters.blocks[i].last]
    for waiting in (*([i] for i in learned if i not in last), last if objective.learn_last else []):
        while waiting:
            choices = {i: choice(i) for i in waiting}
            i = max(waiting, key=lambda k: choices[k][0])
            waiting.remove(i)
            _, chosen[i], taken = choices[i]
            prior = model.believed(i, taken.covariance, prior)
    parameters = replace(parameters, nuisance_precision=prior[n:, n:])
    return replace(objective, parameters=parameters, chosen=tuple(chosen))


def with_edges(objective: Objective, evaluation: Evaluation, unknowns: NDArray[np.float64]) -> Objective:
    """The objective whose blocks of a total variation have the normal law that is it to second order.

    Where, with the residuals linear around unknowns (n_unknowns,), the block's x is likeliest, block after block, the
    others following: with the gradient g and the curvature H there of minus the logarithm of what is believed, N(x -
    H^-1 g, H^-1). The minimum is that of the variation itself, and its posterior Laplace's.
    """
    parameters, n = objective.parameters, objective.n_parameters
    numbers = [i for i, block in enumerate(parameters.blocks) if block.variation]
    if not numbers:
        return objective
    prior, centre = parameters.prior_matrix, parameters.prior_centre
    model = normal_model(parameters, evaluation, unknowns)
    for i in numbers:
        columns, variation = parameters.columns(i), parameters.blocks[i].variation
        assert variation is not None
        centre[columns] = 0.0
        with determined():
            seen = _schur_complement(model.data + prior, model.data, model.pull + prior @ centre, columns)
            x = variation.least(*seen, unknowns[columns])
            prior[np.ix_(columns, columns)] = curvature = variation.curvature(x)
            away = linalg.solve(curvature, variation.gradient(x), assume_a="pos")
        centre[columns] = x - away
    believed = replace(parameters, nuisance_precision=prior[n:, n:], nuisance_mean=centre[n:])
    return replace(objective, parameters=believed)


def _admissible(blocks: Sequence[Block], number: int, chosen: Sequence[int | None]) -> Block:
    """A block with the alternatives that other blocks' choices leave to it (see `Block.rivals`)."""
    block = blocks[number]
    rivals = any(k for other, k in zip(blocks, chosen, strict=True) if other.cause in block.rivals)
    return replace(block, alternatives=block.alternatives[:-1], odds=block.odds[:-1]) if rivals else block


def normal_model(parameters: ParameterMap, evaluation: Evaluation, unknowns: NDArray[np.float64]) -> NormalModel:
    """That of residuals which are linear around unknowns (n,), where they were evaluated."""
    data = evaluation.matrix - evaluation.prior
    return NormalModel(parameters, data, data @ unknowns - (evaluation.score - evaluation.prior_score))


class Belief(NamedTuple):
    """An alternative of a block at its best: its log-evidence with its log prior odds, and its covariance (m, m)."""

    evidence: float
    covariance: NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class NormalModel:
    """Linear residuals: the information A = J^T W J of all unknowns, `data` (n, n), and the pull A x - J^T W r (n,)."""

    parameters: ParameterMap
    data: NDArray[np.float64]
    pull: NDArray[np.float64]

    def beliefs(self, i: int, chosen: Sequence[int | None], prior: NDArray[np.float64]) -> list[Belief]:
        """Those of block i that the alternatives `chosen` for the others leave it, others under a prior (n, n)."""
        block, columns = _admissible(self.parameters.blocks, i, chosen), self.parameters.columns(i)
        pull, odds = self.pull + prior @ self.parameters.prior_centre, block.odds or (0.0,) * len(block.alternatives)
        with determined():
            seen = _Whitened.of(*_schur_complement(self.data + prior, self.data, pull, columns))
            return [_most_evident(terms, seen, block, odd) for terms, odd in zip(block.alternatives, odds, strict=True)]

    def beliefs_beside(self, i: int, chosen: Sequence[int | None], prior: NDArray[np.float64]) -> list[Belief]:
        """The same, each with what its rivals gain beside it by more than what is as good, over their first ones."""
        found, cause = list[Belief](), self.parameters.blocks[i].cause
        rivals = [j for j, block in enumerate(self.parameters.blocks) if cause in block.rivals]
        for j in rivals:
            prior = self.believed(j, self.parameters.blocks[j].alternatives[0][0], prior)
        for k, own in enumerate(self.beliefs(i, chosen, prior)):
            beside, among = self.believed(i, own.covariance, prior), [*chosen[:i], k, *chosen[i + 1 :]]
            evidences = [[of.evidence for of in self.beliefs(j, among, beside)] for j in rivals]
            gains = [max(of) - of[0] for of in evidences]
            found.append(own._replace(evidence=own.evidence + sum(gain for gain in gains if gain > AS_GOOD)))
        return found

    def believed(self, i: int, covariance: NDArray[np.float64], prior: NDArray[np.float64]) -> NDArray[np.float64]:
        """A prior (n, n) with another covariance (m, m) of block i."""
        columns, found = self.parameters.columns(i), prior.copy()
        with determined():
            found[np.ix_(columns, columns)] = linalg.inv(covariance)
        return found


def _schur_complement(
    matrix: NDArray[np.float64], data: NDArray[np.float64], pull: NDArray[np.float64], columns: NDArray[np.int64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """What data say of k unknowns `columns` when all else follows: information A (k, k), pull b = A x - J^T W r (k,).

    The Schur complement of the information `data`, the others under their prior; matrix (n, n): the data's and the
    prior's; pull (n,): likewise, with the prior's mean.
    """
    rest = np.setdiff1d(np.arange(len(pull)), columns)
    across = data[np.ix_(rest, columns)]
    scale = 1.0 / np.sqrt(np.maximum(np.diag(matrix)[rest], 1e-30))
    scaled = scale[:, None] * matrix[np.ix_(rest, rest)] * scale
    scaled[np.diag_indices_from(scaled)] += 1e-10  # a modulus that moves nothing
    right = scale[:, None] * np.column_stack([across, pull[rest]])
    followed = across.T @ (scale[:, None] * linalg.solve(scaled, right, assume_a="pos", check_finite=False))
    information = data[np.ix_(columns, columns)] - followed[:, :-1]
    return 0.5 * (information + information.T), pull[columns] - followed[:, -1]


def _most_evident(terms: Sequence[NDArray[np.float64]], seen: _Whitened, block: Block, odds: float) -> Belief:
    """The largest log-evidence, with its log prior odds, of a family of priors of a block."""
    floor = 0.0 if block.acts is Acts.MATERIAL else LEAST_VARIANCE  # a field's levels leave no mode without variance
    floored = [term + floor * np.eye(len(term)) for term in terms]
    evidence, limits = seen.log_evidence(floored), np.log(block.amplitudes)

    def worse(logs: NDArray[np.float64]) -> tuple[float, NDArray[np.float64]]:
        """Minus the log-evidence at ln of the amplitudes (n_terms,), with its derivative."""
        squares = np.exp(2.0 * logs)
        value, slopes = evidence(squares)
        return -value, -2.0 * squares * slopes

    start, bounds = np.zeros(len(terms)).clip(*limits), [tuple(limits)] * len(terms)
    # to its end: terms that explain the same make a long valley
    best = optimize.minimize(worse, start, jac=True, method="L-BFGS-B", bounds=bounds, options={"ftol": 1e-12})
    squares = np.exp(2.0 * best.x)
    covariance = sum((s * t for s, t in zip(squares, floored, strict=True)), np.zeros_like(terms[0]))
    return Belief(odds - float(best.fun), covariance)
