"""A second observation, which only tests know: one point of the body whose displacement has been seen."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy import sparse

from palpate.observation.contract import Fit, Residuals, Weighting
from palpate.observation.noise_model import NoiseModel
from palpate.observation.robust_loss import PowerLaw

APART = 0.5  # mm: correlation length; the three axes of a point are independent anyway


@dataclass(frozen=True, slots=True)
class PointMotion:
    """Displacement seen (3,) mm of the point with a number, at rest (3,) mm, with a stated noise; an `Observation`."""

    point: int
    rest: np.ndarray
    seen: np.ndarray
    stated_noise: NoiseModel
    noise_model: NoiseModel
    weighting: Weighting
    name: str = "landmark"
    kind: str = "point motion"
    description: str = "the displacement of points that were seen in both images"
    of_driver: bool = False
    unit: str = "mm"
    observed_share: float = 1.0

    @property
    def dofs(self):
        return 3 * self.point + np.arange(3)

    def residuals(self, displacement, offset=0.0):
        identity = sparse.csr_matrix(np.eye(3))
        places = np.tile(self.rest + displacement, (3, 1))
        material = np.tile(self.rest, (3, 1))
        weights = np.full(3, 1.0 / 3.0)
        return Residuals(displacement - self.seen + offset, weights, places, np.eye(3), material, identity)

    def with_noise(self, noise):
        return replace(self, noise_model=noise, weighting=Weighting(3.0 / noise.sd**2, PowerLaw(), 3.0))

    @property
    def sd_bounds(self):
        return self.stated_noise.sd, self.stated_noise.sd

    def with_sd(self, sd):
        return replace(self, weighting=Weighting(3.0 / sd**2, PowerLaw(), 3.0))

    def with_correlation(self, noise):
        return replace(self, noise_model=noise)

    def weighed(self, residuals):
        return residuals

    def first_noise(self, _peers):
        return self.stated_noise

    def fitted_noise(self, _residuals, _response=None):
        return self.stated_noise

    def fit(self, residuals):
        length = float(np.linalg.norm(residuals.values))
        return Fit(length, length, length, None)


def point_motion(point, rest, seen, *, sd_mm) -> PointMotion:
    """The observation of one point by its number, with noise of sd_mm."""
    noise = NoiseModel(np.array([sd_mm**2]), np.array([APART]))
    return PointMotion(point, rest, seen, noise, noise, Weighting(1.0, PowerLaw())).with_noise(noise)
