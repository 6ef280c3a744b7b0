"""What is set while a search is under way: size and number of the residuals' independent errors, and amplitudes.

Amplitudes are those of how far walls move, and of how otherwise a reference image is drawn.

A wall that moves by 3 mm as one piece must not be allowed to slide by 5 mm on its own: nothing in the images holds it
back along itself, and the moduli then pay for it.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray
from scipy import linalg, optimize

from palpate.approximation.contract import determined
from palpate.inversion.objective import Evaluation, Linearisation, Objective
from palpate.observation.contract import Observation
from palpate.observation.noise_model import NoiseModel
from palpate.unknowns.arrowhead import Arrowhead
from palpate.unknowns.blocks import AMPLITUDES, LEAST_VARIANCE, Alternative
from palpate.unknowns.parameters import ParameterMap

FITTED = 0.5  # largest share of a kind's residuals that counts as fitted by the unknowns
DRIVER_LN_SD = float(np.log(2.0))  # standard deviation of ln of a driver's scale over that of its kind
SWEEPS, SETTLED = 300, 3e-3  # of the amplitudes; relative change of every variance at which they end


def with_first_noise(objective: Objective) -> Objective:
    """The objective before any residual is seen: all count by the noise that each kind begins with in its image."""
    seen = [(s, o, state.observations) for s, state in enumerate(objective.states) for o in state.observations]
    noise = {(s, o.kind): o.first_noise([p for p in peers if p.kind == o.kind]) for s, o, peers in seen}
    return _of_each(objective, lambda s, o: o.with_noise(noise[s, o.kind]))


def with_correlations(objective: Objective, evaluation: Evaluation) -> Objective:
    """The objective with the numbers of independent residuals that those of an evaluation tell; their scales stay."""
    noise = fitted_noise(evaluation)
    return _of_each(objective, lambda s, o: o.with_correlation(noise[s, o.kind]))


def with_scales(objective: Objective, evaluation: Evaluation) -> Objective:
    """The scales s with the least objective, one of each kind and later image, and of a driver no smaller one.

    d/d ln s of 1/2 ln det H is -g, g = tr H^-1 J^T W J the number of unknowns that the residuals determine (MacKay
    1992): s^2 = n rho / (n - g) of a mean square rho where no outlier is.
    """
    linearisations, found = evaluation.linearisations, dict[int, float]()
    determine, inverse = list[float](), dict[int, NDArray[np.float64]]()
    with determined():
        eliminated = evaluation.matrix.grounded().eliminated()
        for term in linearisations:
            if term.state not in inverse:  # all observations of a state have the same unknowns
                inverse[term.state] = eliminated.inverse_among(term.columns)
            determine.append(float(np.sum(inverse[term.state] * term.information)))
    for own, telling in of_one_noise(evaluation).values():
        pooled = _scale([linearisations[i] for i in telling], sum(determine[i] for i in telling), 0.0)
        apart = [i for i in own if i not in telling]
        found |= dict.fromkeys(own, pooled)
        found |= {i: _scale([linearisations[i]], determine[i], pooled) for i in apart}
    pairs = enumerate(objective.observations)
    return objective.with_observations([o.with_sd(found[i]) for i, o in pairs])


def _scale(linearisations: Sequence[Linearisation], determine: float, least: float) -> float:
    """The scale (mm) of some observations' residuals, at least `least`; these `determine` so many unknowns."""
    count = sum(term.observation.weighting.count for term in linearisations)
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


def worse_driver(sd: float, kind_sd: float) -> float:
    """Minus the log prior of a driver's scale: as that of its kind, or larger, by a factor of 2 seldom."""
    return 0.5 * (max(float(np.log(sd / kind_sd)), 0.0) / DRIVER_LN_SD) ** 2


def with_amplitudes(objective: Objective, evaluation: Evaluation, unknowns: NDArray[np.float64]) -> Objective:
    """The objective with the amplitudes of blocks' terms that have the largest evidence, block after block.

    The residuals are linear around unknowns (n_unknowns,). With A and b what data say of the block when all else
    follows, and its covariance C = sum_t v_t C_t, the log-evidence is 1/2 (b^T (A + C^-1)^-1 b - ln det(1 + C A))
    (MacKay 1992, Neural Computation 4, 415-447, section 4). Raises `EstimationError` where the images leave another
    unknown open.
    """
    data = evaluation.matrix - evaluation.prior
    pull = data @ unknowns - (evaluation.score - evaluation.prior_score)
    for i, block in enumerate(objective.parameters.blocks):
        if block.terms:
            parameters = objective.parameters
            with determined():
                pulled = pull + parameters.prior_pull
                information, of_own = _seen_of(parameters, data, pulled, i)
                terms = [term + LEAST_VARIANCE * np.eye(block.size) for term in block.terms]
                variances = evident_variances(terms, information, of_own)
                covariance = np.tensordot(variances, np.stack(terms), axes=1)
            learned = Alternative(np.asarray(covariance), variances=tuple(variances.tolist()))
            objective = objective.with_prior(parameters.with_priors({i: learned}))
    return objective


def evident_variances(
    terms: Sequence[NDArray[np.float64]],
    information: NDArray[np.float64],
    pull: NDArray[np.float64],
    *,
    sweeps: int = SWEEPS,
) -> NDArray[np.float64]:
    """The variances v (n_terms,) of a prior sum_t v_t C_t, C_t (n, n), of the largest evidence.

    information A (n, n) = R^T R and pull b = R^T t (n,) are what data say. With D_t = R C_t R^T and K = sum_t v_t D_t,
    v_t <- v_t (w^T D_t w / tr((1 + K)^-1 D_t))^(1/2), w = (1 + K)^-1 t: every sweep raises the evidence (Zhou, Hu, Zhou
    & Lange, J. Comput. Graph. Stat. 28 (2019) 350). A term that moves nothing seen keeps 1, with which it begins;
    `sweeps`: the largest number.
    """
    sizes, vectors = linalg.eigh(information, check_finite=False)
    kept = sizes > len(sizes) * np.finfo(np.float64).eps * sizes[-1]
    kept[-1] = True
    roots, axes = np.sqrt(np.maximum(sizes[kept], np.finfo(np.float64).tiny)), vectors[:, kept].T
    target, seen = (
        axes @ pull / roots,
        np.stack([(roots[:, None] * axes) @ c @ (roots[:, None] * axes).T for c in terms]),
    )
    low, high = np.square(AMPLITUDES)
    variances = np.ones(len(terms))
    for _ in range(sweeps):
        inverse = np.linalg.inv(np.eye(len(target)) + np.tensordot(variances, seen, axes=1))
        at_best = inverse @ target
        explained = np.einsum("i,tij,j->t", at_best, seen, at_best, optimize=True)
        expected = np.einsum("tij,ij->t", seen, inverse)
        ratios = np.divide(explained, expected, out=np.ones(len(terms)), where=expected > np.finfo(np.float64).eps)
        before, variances = variances, np.clip(variances * np.sqrt(ratios), low, high)
        if np.all(np.abs(variances - before) < SETTLED * before):
            break
    return variances


def _seen_of(
    parameters: ParameterMap, data: Arrowhead, pull: NDArray[np.float64], block: int
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """What data say of the k unknowns of a block when all else follows: information (k, k) and pull (k,).

    The Schur complement of the information `data`, the others under their prior, whose mean is in the pull (n,).
    """
    own = parameters.columns(block)
    prior = parameters.prior_matrix.plus([(own, -parameters.priors[block].precision)])
    matrix = data + prior
    ridge = 1e-10 * np.maximum(matrix.diagonal, 1e-30)  # a modulus that moves nothing
    ridge[own] = 0.0
    information, of_own = matrix.plus_diagonal(ridge).complement(own, pull)
    return 0.5 * (information + information.T), of_own
