"""Samples of the moduli's posterior: the result's own chains, else log-normal draws from its covariance."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from palpate.export.fitted_model import FittedModel
from palpate.study.samples import CHAINS

DRAWS = 1000
SEED = 0
LINEARISED = "linearised: independent draws, log-normal about the estimate"
SAMPLED = "sampled: Markov chains around the estimate, stretched to the covariance of its interval"


@dataclass(frozen=True, slots=True)
class Samples:
    """moduli (chains, draws, n) of n `tissues` in the model's unit; kind: what they are, in words.

    log_density (chains, draws): of their logarithms; of chains, of all unknowns and but for a constant.
    """

    tissues: tuple[str, ...]
    moduli: NDArray[np.float64]
    log_density: NDArray[np.float64]
    kind: str


def moduli_samples(model: FittedModel) -> Samples:
    """The model's own chains; without any, draws with ln E normal about the estimates under their covariance.

    The latter are independent, in chains for programs that compare chains.
    """
    if model.samples is not None:
        found = model.samples
        return Samples(found.tissues, found.moduli, found.log_density, SAMPLED)
    centre = np.log([item.value if model.unit == "kPa" else item.ratio for item in model.estimates])  # type: ignore
    n = len(centre)
    normal = np.random.default_rng(SEED).standard_normal((CHAINS, DRAWS, n))
    values, vectors = np.linalg.eigh(model.covariance)
    spread = np.sqrt(np.maximum(values, 0.0))
    logarithms = centre + (normal * spread) @ vectors.T
    scale = float(np.log(spread[spread > 0.0]).sum()) + 0.5 * n * np.log(2.0 * np.pi)
    density = -0.5 * (normal**2).sum(axis=2) - scale
    return Samples(tuple(item.tissue for item in model.estimates), np.exp(logarithms), density, LINEARISED)
