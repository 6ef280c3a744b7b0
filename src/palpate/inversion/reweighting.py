"""How much each residual counts: noise model, robust losses, drivers' prior, and what belongs together."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from palpate.inversion.evidence import with_edges, with_learned_prior
from palpate.inversion.objective import Evaluation, Linearisation, Objective
from palpate.inversion.optimise import Minimum
from palpate.observation.noise_model import NoiseModel

RIDGE = 1e-9  # of the mean diagonal: a mode that moves no observed point


def with_first_noise(objective: Objective) -> Objective:
    """The objective before any residual is seen: all count by the noise that each kind begins with in its image."""
    seen = [(s, o, state.observations) for s, state in enumerate(objective.states) for o in state.observations]
    noise = {(s, o.kind): o.first_noise([p for p in peers if p.kind == o.kind]) for s, o, peers in seen}
    return _by_noise(objective, noise)


def with_found_noise(objective: Objective, minimum: Minimum) -> Objective:
    """The objective under the noise that the residuals at a minimum tell, by which all of them count."""
    return _by_noise(objective, fitted_noise(minimum.evaluation)).rematched(minimum.unknowns)


def reweighted(objective: Objective, minimum: Minimum) -> Objective:
    """What the residuals at a minimum of `objective` say: their noise, the blocks' prior, robust losses.

    The next minimum is sought under the objective that is returned, once that is `rematched`; an estimate has converged
    when that is the same. Raises `EstimationError` where the images leave a driver's motion open.
    """
    evaluation = minimum.evaluation
    believed = with_edges(with_learned_prior(objective, evaluation, minimum.unknowns), evaluation, minimum.unknowns)
    by_noise = _by_noise(believed, fitted_noise(evaluation))
    pairs = zip(by_noise.observations, evaluation.lines, strict=True)
    n = objective.n_parameters
    return by_noise.with_observations([o.reweighted(line.residuals, _beyond_modes(line, n)) for o, line in pairs])


def fitted_noise(evaluation: Evaluation) -> dict[tuple[int, str], NoiseModel]:
    """Noise model by later state and kind of observation, of the residuals that tell (see `of_one_noise`).

    Each later image has its own: one that was drawn badly would else take from what the others are believed.
    """
    lines, groups = evaluation.lines, of_one_noise(evaluation)
    told = {key: [lines[i] for i in telling] for key, (_, telling) in groups.items()}
    return {key: of[0].observation.fitted_noise([line.residuals for line in of]) for key, of in told.items()}


def of_one_noise(evaluation: Evaluation) -> dict[tuple[int, str], tuple[list[int], list[int]]]:
    """Numbers of the observations of each later state and kind, which share a noise model; of those that tell of it.

    Modes flatten a driver's residuals: they tell where nothing else is seen.
    """
    groups: dict[tuple[int, str], tuple[list[int], list[int]]] = {}
    for i, line in enumerate(evaluation.lines):
        own, telling = groups.setdefault((line.state, line.observation.kind), ([], []))
        own.append(i)
        telling += [] if line.observation.of_driver else [i]
    return {key: (own, telling or own) for key, (own, telling) in groups.items()}


def _by_noise(objective: Objective, noise: Mapping[tuple[int, str], NoiseModel]) -> Objective:
    states = enumerate(objective.states)
    return objective.with_observations(
        [o.with_noise(noise[s, o.kind]) for s, state in states for o in state.observations]
    )


def _beyond_modes(line: Linearisation, n_parameters: int) -> NDArray[np.float64] | None:
    """What of a driver's residuals r (n,) mm no coefficients take away: (1 - J_q (J_q^T W J_q)^-1 J_q^T W) r.

    J_q: their columns, of its modes. None where no driver is seen.
    """
    if not line.observation.of_driver:
        return None
    values, by_modes = line.residuals.values, line.jacobian.of_columns(np.arange(n_parameters, line.jacobian.shape[1]))
    matrix = by_modes.gram(line.weights)
    ridge = RIDGE * max(float(np.trace(matrix)) / max(len(matrix), 1), np.finfo(float).tiny)
    step = np.asarray(
        np.linalg.solve(matrix + ridge * np.eye(len(matrix)), by_modes.transposed_times(line.weights * values))
    )
    return np.asarray(values - by_modes.times(step))
