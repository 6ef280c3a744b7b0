"""What observations have in common whose errors a case states: independent ones, alike in all of the residuals."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Self

import numpy as np

from palpate.observation.contract import Fit, Residuals, Weighting
from palpate.observation.noise_model import FitResponse, NoiseModel
from palpate.observation.robust_loss import FAR, PowerLaw

MAD = 1.4826  # standard deviations of a normal law in one median absolute deviation
ALONE = 1e-3  # mm, correlation length that stands for independent errors
FEW = 30  # residuals, below which their spread is not reported


def stated_noise(sd: float, n: int) -> tuple[NoiseModel, NoiseModel, Weighting]:
    """The `stated`, `noise_model` and `weighting` of n residuals whose errors have the standard deviation sd."""
    stated = NoiseModel(np.array([sd**2]), np.array([ALONE]))
    return stated, stated, Weighting(n / sd**2, PowerLaw(), float(n))


@dataclass(frozen=True, slots=True)
class StatedNoise:
    """The part of an `Observation` that is the same for all data with a stated noise, which show no wall."""

    name: str
    stated: NoiseModel
    noise_model: NoiseModel
    weighting: Weighting

    of_driver = False
    observed_share = 1.0

    @property
    def kind(self) -> str:
        """Its name: each has errors of its own."""
        return self.name

    def with_noise(self, noise: NoiseModel) -> Self:
        """All residuals count, by the variance of the noise."""
        n = self.weighting.count
        return replace(self, noise_model=noise, weighting=Weighting(n / noise.sd**2, PowerLaw(), n))

    @property
    def sd_bounds(self) -> tuple[float, float]:
        """From what is stated on; no more where residuals are too few to tell."""
        return self.stated.sd, np.inf if self.weighting.count >= FEW else self.stated.sd

    def with_sd(self, sd: float) -> Self:
        """The same; what all else contradicts, as a mistaken point, counts less, the further off it is."""
        n = self.weighting.count
        return replace(self, weighting=Weighting(n / sd**2, PowerLaw(FAR * sd), n))

    def with_correlation(self, noise: NoiseModel) -> Self:
        """The same noise: its residuals are independent."""
        return replace(self, noise_model=noise)

    def weighed(self, residuals: Residuals) -> Residuals:
        """The same: every residual counts alike."""
        return residuals

    def first_noise(self, peers: Sequence[Self]) -> NoiseModel:
        """What is stated."""
        del peers
        return self.stated

    def fitted_noise(self, residuals: Sequence[Residuals], response: FitResponse | None = None) -> NoiseModel:
        """What is stated, or the residuals' robust spread where that is larger."""
        del response
        every = np.concatenate([found.values for found in residuals])
        spread = MAD * float(np.median(np.abs(every))) if len(every) >= FEW else 0.0
        return self.stated if spread <= self.stated.sd else NoiseModel(np.array([spread**2]), self.stated.lengths)

    def fit(self, residuals: Residuals) -> Fit:
        """How far the model is off, in the residuals' unit; of points their distances to where they were measured."""
        away = np.abs(residuals.values) if residuals.distances is None else residuals.distances
        return Fit(float(away.mean()), float(np.sqrt(np.mean(away**2))), float(np.quantile(away, 0.95)), None)
