"""Samples of the moduli's posterior: log-normal, from the covariance that the intervals come from."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from palpate.export.fitted_model import FittedModel

__all__ = ["CHAINS", "DRAWS", "Samples", "moduli_samples"]

CHAINS, DRAWS = 4, 1000
SEED = 0


@dataclass(frozen=True, slots=True)
class Samples:
    """moduli (CHAINS, DRAWS, n) of n `tissues` in the model's unit, log_density (CHAINS, DRAWS) of their logarithms.

    Independent draws: the chains are there for programs that compare chains.
    """

    tissues: tuple[str, ...]
    moduli: NDArray[np.float64]
    log_density: NDArray[np.float64]


def moduli_samples(model: FittedModel) -> Samples:
    """Draws with ln E normal about the estimates under their covariance: "linearised", as `interval_kind` has it."""
    centre = np.log([item.value if model.unit == "kPa" else item.ratio for item in model.estimates])  # type: ignore
    n = len(centre)
    normal = np.random.default_rng(SEED).standard_normal((CHAINS, DRAWS, n))
    values, vectors = np.linalg.eigh(model.covariance)
    spread = np.sqrt(np.maximum(values, 0.0))
    logarithms = centre + (normal * spread) @ vectors.T
    scale = float(np.log(spread[spread > 0.0]).sum()) + 0.5 * n * np.log(2.0 * np.pi)
    density = -0.5 * (normal**2).sum(axis=2) - scale
    return Samples(tuple(item.tissue for item in model.estimates), np.exp(logarithms), density)
