"""Robust losses, each minus the logarithm of a density: Huber's, and one with a power law's tails."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray
from scipy.special import erf

HUBER, FAR = 1.345, 3.0  # cutoffs in standard deviations: 95 and 99 % efficient for normal errors (Huber 1981)


class RobustLoss(Protocol):
    """A loss rho(r) with the slope 2 r w(r): p(r) = exp(-rho(r) / (2 s^2)) / Z(s) is a density of scale s."""

    @property
    def cutoff(self) -> float:
        """Residuals (mm) up to which it is their square."""
        ...

    def weight(self, residuals: NDArray[np.float64]) -> NDArray[np.float64]:
        """Weights w (n,), 0 to 1, of residuals (n,) mm."""
        ...

    def rho(self, residuals: NDArray[np.float64]) -> NDArray[np.float64]:
        """Losses (n,) mm^2 of residuals (n,) mm."""
        ...

    def log_normaliser(self, sd: float) -> float:
        """Ln Z(s) at a scale s = sd, mm: the integral of exp(-rho / (2 s^2)), over sqrt(2 pi) mm."""
        ...


@dataclass(frozen=True, slots=True)
class Huber:
    """rho(r) = r^2 for |r| < c, else c (2 |r| - c): an outlier's pull is bounded, and never none.

    cutoff: c, mm. It is convex, so that residuals linear in the unknowns have one minimum (Huber, Robust Statistics,
    1981, section 7.8).
    """

    cutoff: float

    def weight(self, residuals: NDArray[np.float64]) -> NDArray[np.float64]:
        """Weights min(1, c / |r|) (n,) of residuals (n,) mm."""
        return np.asarray(self.cutoff / np.maximum(np.abs(residuals), self.cutoff))

    def rho(self, residuals: NDArray[np.float64]) -> NDArray[np.float64]:
        """Losses rho (n,) mm^2 of residuals (n,) mm."""
        size = np.abs(residuals)
        return np.asarray(np.where(size < self.cutoff, size**2, self.cutoff * (2.0 * size - self.cutoff)))

    def log_normaliser(self, sd: float) -> float:
        """Ln Z, k = c/s: Z / (sqrt(2 pi) s) = erf(k / sqrt 2) + sqrt(2 / pi) / k e^(-k^2 / 2)."""
        k = self.cutoff / sd
        return float(np.log(sd) + np.log(erf(k / np.sqrt(2.0)) + np.sqrt(2.0 / np.pi) / k * np.exp(-0.5 * k**2)))


@dataclass(frozen=True, slots=True)
class PowerLaw:
    """rho(r) = r^2 for |r| < c, else c^2 (1 + ln(r^2 / c^2)): the pull of an outlier falls with its distance.

    cutoff: c, mm, inf for rho = r^2. The density is normal up to c and falls as |r|^(-k^2) beyond it, k = c/s > 1.
    """

    cutoff: float = np.inf

    def weight(self, residuals: NDArray[np.float64]) -> NDArray[np.float64]:
        """Weights min(1, c^2 / r^2) (n,) of residuals (n,) mm."""
        if not np.isfinite(self.cutoff):
            return np.ones(len(residuals))
        return np.asarray((self.cutoff / np.maximum(np.abs(residuals), self.cutoff)) ** 2)

    def rho(self, residuals: NDArray[np.float64]) -> NDArray[np.float64]:
        """Losses rho (n,) mm^2 of residuals (n,) mm."""
        if not np.isfinite(self.cutoff):
            return np.asarray(residuals**2)
        size, c = np.abs(residuals), self.cutoff
        return np.asarray(np.minimum(size, c) ** 2 + 2.0 * c**2 * np.log(np.maximum(size, c) / c))

    def log_normaliser(self, sd: float) -> float:
        """Ln Z: Z / (sqrt(2 pi) s) = erf(k / sqrt 2) + sqrt(2 / pi) k / (k^2 - 1) e^(-k^2 / 2)."""
        k = self.cutoff / sd
        if not np.isfinite(k):
            return float(np.log(sd))
        tail = np.sqrt(2.0 / np.pi) * k / (k**2 - 1.0) * np.exp(-0.5 * k**2)
        return float(np.log(sd) + np.log(erf(k / np.sqrt(2.0)) + tail))
