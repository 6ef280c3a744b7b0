"""How much each residual counts: noise model, robust losses, drivers' prior, and what belongs together."""

from __future__ import annotations

from collections.abc import Mapping

from palpate.inversion.driver import with_learned_prior
from palpate.inversion.objective import Evaluation, Objective
from palpate.inversion.optimise import Minimum
from palpate.observation.contract import Observation
from palpate.observation.noise_model import NoiseModel

__all__ = ["fitted_noise", "reweighted", "with_first_noise"]


def with_first_noise(objective: Objective) -> Objective:
    """The objective before any residual is seen: all count by the noise that each kind of observation starts with."""
    kinds = {kind: peers[0].first_noise(peers) for kind, peers in _by_kind(objective.observations).items()}
    return _by_noise(objective, kinds)


def reweighted(objective: Objective, minimum: Minimum) -> Objective:
    """What the residuals at a minimum of `objective` say: their noise, the drivers' prior, robust losses.

    The next minimum is sought under the objective that is returned, once that is `rematched`; an estimate has converged
    when that is the same. Raises `EstimationError` where the images leave a driver's motion open.
    """
    evaluation = minimum.evaluation
    believed = with_learned_prior(objective, evaluation, minimum.unknowns)
    by_noise = _by_noise(believed, fitted_noise(evaluation))
    pairs = zip(by_noise.observations, evaluation.lines, strict=True)
    return by_noise.with_observations([o.reweighted(line.residuals) for o, line in pairs])


def fitted_noise(evaluation: Evaluation) -> dict[str, NoiseModel]:
    """Noise model of each kind of observation, by the residuals that tell: a driver's are flattened by its modes."""
    found = {}
    for kind, peers in _by_kind([line.observation for line in evaluation.lines]).items():
        of_kind = [line for line in evaluation.lines if line.observation.kind == kind]
        telling = [line.residuals for line in of_kind if not line.observation.of_driver]
        found[kind] = peers[0].fitted_noise(telling or [line.residuals for line in of_kind])
    return found


def _by_kind(observations: list[Observation]) -> dict[str, list[Observation]]:
    kinds = dict.fromkeys(observation.kind for observation in observations)
    return {kind: [o for o in observations if o.kind == kind] for kind in kinds}


def _by_noise(objective: Objective, noise: Mapping[str, NoiseModel]) -> Objective:
    return objective.with_observations([o.with_noise(noise[o.kind]) for o in objective.observations])
