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
from palpate.inversion.by_image import among, shared_by, solve_by_image
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
    return with_amplitudes(with_scales(objective, evaluation), evaluation, unknowns)


def with_scales(objective: Objective, evaluation: Evaluation) -> Objective:
    """The scales s with the least objective, one of each kind and later image, and of a driver no smaller one.

    d/d ln s of 1/2 ln det H is -g, g = tr H^-1 J^T W J the number of unknowns that the residuals determine (MacKay
    1992): s^2 = n rho / (n - g) of a mean square rho where no outlier is.
    """
    linearisations, found, inverse = evaluation.linearisations, dict[int, float](), np.zeros_like(evaluation.matrix)
    matrix = evaluation.matrix
    seen = np.flatnonzero(np.diag(matrix) > 0.0)
    with determined():
        within = np.ix_(seen, seen)
        images = among(evaluation.images, np.diag(matrix) > 0.0)
        inverse[within] = solve_by_image(matrix[within], np.eye(len(seen)), images)
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
    model = normal_model(parameters, evaluation, unknowns)

    def choice(i: int) -> tuple[float, int, Belief]:
        """The gain of a block's best alternative, the number of the one it takes, and that one's covariance."""
        block, beliefs = parameters.blocks[i], model.beliefs(i, chosen)
        best = max(range(len(beliefs)), key=lambda k: beliefs[k].evidence)
        present = chosen[i] if chosen[i] in range(len(beliefs)) else None
        if present is None and block.acts is Acts.MATERIAL:
            present = 0
        if present is None and objective.learn_last and block.slight and best == 1:
            beliefs, present = model.beliefs_beside(i, chosen)[:2], 0
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
            model = model.believing(i, taken.covariance)
    parameters = replace(parameters, nuisance_precision=model.prior[n:, n:])
    return replace(objective, parameters=parameters, chosen=tuple(chosen))


def _admissible(blocks: Sequence[Block], number: int, chosen: Sequence[int | None]) -> Block:
    """A block with the alternatives that other blocks' choices leave to it (see `Block.rivals`)."""
    block = blocks[number]
    rivals = any(k for other, k in zip(blocks, chosen, strict=True) if other.cause in block.rivals)
    return replace(block, alternatives=block.alternatives[:-1], odds=block.odds[:-1]) if rivals else block


def normal_model(parameters: ParameterMap, evaluation: Evaluation, unknowns: NDArray[np.float64]) -> NormalModel:
    """That of residuals which are linear around unknowns (n,), where they were evaluated, under the prior there."""
    data, prior = evaluation.matrix - evaluation.prior, evaluation.prior
    pull = data @ unknowns - (evaluation.score - evaluation.prior_score) + prior @ parameters.prior_centre
    model = NormalModel(parameters, data, pull, prior, ())
    return replace(model, followed=tuple(model.what_follows(own) for own in parameters.images))


class Belief(NamedTuple):
    """An alternative of a block at its best: its log-evidence with its log prior odds, and its covariance (m, m)."""

    evidence: float
    covariance: NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class NormalModel:
    """Linear residuals under a normal prior, of which the images' own unknowns may follow the others.

    data (n, n): the information A = J^T W J of all unknowns; pull (n,): A x - J^T W r + P m; prior (n, n): P; followed:
    of each of several images what its own unknowns y take from information and pull of those that all share,
    A_sy (A + P)_yy^-1 A_ys (n_shared, n_shared) and A_sy (A + P)_yy^-1 b_y (n_shared,).
    """

    parameters: ParameterMap
    data: NDArray[np.float64]
    pull: NDArray[np.float64]
    prior: NDArray[np.float64]
    followed: tuple[tuple[NDArray[np.float64], NDArray[np.float64]], ...]

    def beliefs(self, i: int, chosen: Sequence[int | None]) -> list[Belief]:
        """Those of block i that the alternatives `chosen` for the others leave it."""
        block, odds = _admissible(self.parameters.blocks, i, chosen), self.parameters.blocks[i].odds
        odds = odds or (0.0,) * len(block.alternatives)
        with determined():
            seen = _Whitened.of(*self._seen(i))
        return [_most_evident(terms, seen, block, odd) for terms, odd in zip(block.alternatives, odds, strict=False)]

    def beliefs_beside(self, i: int, chosen: Sequence[int | None]) -> list[Belief]:
        """The same, each with what its rivals gain beside it by more than what is as good, over their first ones."""
        found, cause, model = list[Belief](), self.parameters.blocks[i].cause, self
        rivals = [j for j, block in enumerate(self.parameters.blocks) if cause in block.rivals]
        for j in rivals:
            model = model.believing(j, self.parameters.blocks[j].alternatives[0][0])
        for k, own in enumerate(model.beliefs(i, chosen)):
            beside, among_them = model.believing(i, own.covariance), [*chosen[:i], k, *chosen[i + 1 :]]
            evidences = [[of.evidence for of in beside.beliefs(j, among_them)] for j in rivals]
            gains = [max(of) - of[0] for of in evidences]
            found.append(own._replace(evidence=own.evidence + sum(gain for gain in gains if gain > AS_GOOD)))
        return found

    def believing(self, i: int, covariance: NDArray[np.float64]) -> NormalModel:
        """The same under a prior with another covariance (m, m) of block i."""
        columns, prior, followed = self.parameters.columns(i), self.prior.copy(), list(self.followed)
        with determined():
            prior[np.ix_(columns, columns)] = linalg.inv(covariance)
        change = prior[columns] - self.prior[columns]
        pull = self.pull.copy()
        pull[columns] += change @ self.parameters.prior_centre
        model = replace(self, prior=prior, pull=pull)
        for k, own in enumerate(self.parameters.images):
            if columns[0] in own:
                followed[k] = model.what_follows(own)
        return replace(model, followed=tuple(followed))

    def what_follows(self, own: NDArray[np.int64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """What an image's own unknowns (m,) take from information and pull of those that all share (see above)."""
        shared = shared_by(self.parameters.images, len(self.pull))
        across = self.data[np.ix_(own, shared)]
        with determined():
            answer = _following(self.data, self.prior, own, np.column_stack([across, self.pull[own]]))
        taken = across.T @ answer
        return taken[:, :-1], taken[:, -1]

    def _seen(self, i: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """What the data say of block i when all else follows (see `_schur_complement`), image by image."""
        columns, images = self.parameters.columns(i), self.parameters.images
        if not images:
            return _schur_complement(self.prior, self.data, self.pull, columns)
        shared = shared_by(images, len(self.pull))
        mine = [k for k, own in enumerate(images) if columns[0] in own]
        others = [taken for k, taken in enumerate(self.followed) if k not in mine]
        numbers = np.concatenate([shared, *(images[k] for k in mine)])
        within, n = np.ix_(numbers, numbers), len(shared)
        data, pull = self.data[within], self.pull[numbers]
        for information, of_pull in others:
            data[:n, :n] -= information
            pull[:n] -= of_pull
        place = np.flatnonzero(np.isin(numbers, columns))
        return _schur_complement(self.prior[within], data, pull, place)


def _schur_complement(
    prior: NDArray[np.float64], data: NDArray[np.float64], pull: NDArray[np.float64], columns: NDArray[np.int64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """What data say of k unknowns `columns` when all else follows: information A (k, k), pull b = A x - J^T W r (k,).

    The Schur complement of the information `data` (n, n), the others under their `prior` (n, n), whose mean is in the
    pull (n,).
    """
    rest = np.setdiff1d(np.arange(len(pull)), columns)
    across = data[np.ix_(rest, columns)]
    followed = across.T @ _following(data, prior, rest, np.column_stack([across, pull[rest]]))
    information = data[np.ix_(columns, columns)] - followed[:, :-1]
    return 0.5 * (information + information.T), pull[columns] - followed[:, -1]


def _following(
    data: NDArray[np.float64], prior: NDArray[np.float64], own: NDArray[np.int64], right: NDArray[np.float64]
) -> NDArray[np.float64]:
    """(A + P)^-1 b (m, k) of some unknowns `own` (m,) with the information and the prior (n, n), b (m, k)."""
    matrix = data[np.ix_(own, own)] + prior[np.ix_(own, own)]
    scale = 1.0 / np.sqrt(np.maximum(np.diag(matrix), 1e-30))[:, None]
    scaled = scale * matrix * scale.T
    scaled[np.diag_indices_from(scaled)] += 1e-10  # a modulus that moves nothing
    return np.asarray(scale * linalg.solve(scaled, scale * right, assume_a="pos", check_finite=False))


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
