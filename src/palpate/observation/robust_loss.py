"""Robust losses: Tukey's biweight, which rejects outliers, and Huber's, which bounds what each can do."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

HUBER = 1.345  # cutoff of `Huber` in standard deviations, 95 % efficient for normal errors
NORMAL = math.erf(HUBER / math.sqrt(2.0))  # mean of w r^2 of standard normal residuals r under that cutoff


class RobustLoss(Protocol):
    """A loss rho(r) with the slope 2 r w(r), and the mean square of the residuals that it believes."""

    @property
    def cutoff(self) -> float:
        """Residuals (mm) from which it grows more slowly than their square, or no longer."""
        ...

    def weight(self, residuals: NDArray[np.float64]) -> NDArray[np.float64]:
        """Weights w (n,), 0 to 1, of residuals (n,) mm."""
        ...

    def rho(self, residuals: NDArray[np.float64]) -> NDArray[np.float64]:
        """Losses (n,) mm^2 of residuals (n,) mm."""
        ...

    def mean_square(self, residuals: NDArray[np.float64], weights: NDArray[np.float64]) -> float:
        """Mean square (mm^2) of residuals (n,) mm with weights (n,), without what outliers add."""
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

    def mean_square(self, residuals: NDArray[np.float64], weights: NDArray[np.float64]) -> float:
        """Mean of w r^2 (mm^2) of residuals r (n,) mm with weights (n,), over that of normal ones of variance 1."""
        return float(np.average(self.weight(residuals) * residuals**2, weights=weights)) / NORMAL


@dataclass(frozen=True, slots=True)
class Tukey:
    """rho(r) with the slope 2 r w(r), w = (1 - s^2 / c^2)^2 for s < c, else 0, and s = max(|r| - a, 0).

    cutoff: c, mm, inf for rho = r^2; spared: a, mm, up to which all residuals count fully. With a = 0 it is the
    biweight of Huber, Robust Statistics (1981), section 4.8.
    """

    cutoff: float = np.inf
    spared: float = 0.0

    def weight(self, residuals: NDArray[np.float64]) -> NDArray[np.float64]:
        """Weights w (n,), 0 to 1, of residuals (n,) mm."""
        return np.asarray((1.0 - self._beyond(residuals) ** 2) ** 2)

    def rho(self, residuals: NDArray[np.float64]) -> NDArray[np.float64]:
        """Losses rho (n,) mm^2 of residuals (n,) mm.

        With t = s / c beyond a: rho = a^2 + c^2/3 (1 - (1 - t^2)^3) + 2 a c (t - 2 t^3/3 + t^5/5).
        """
        if not np.isfinite(self.cutoff):
            return np.asarray(residuals**2)
        a, c, t = np.minimum(np.abs(residuals), self.spared), self.cutoff, self._beyond(residuals)
        falling = t - 2.0 * t**3 / 3.0 + t**5 / 5.0
        return np.asarray(a**2 + c**2 / 3.0 * (1.0 - (1.0 - t**2) ** 3) + 2.0 * a * c * falling)

    def mean_square(self, residuals: NDArray[np.float64], weights: NDArray[np.float64]) -> float:
        """Mean square (mm^2) of the residuals (n,) mm that count at all."""
        inside = self._beyond(residuals) < 1.0
        return float(np.average(residuals[inside] ** 2, weights=weights[inside]))

    def _beyond(self, residuals: NDArray[np.float64]) -> NDArray[np.float64]:
        """How far residuals lie between a and a + c: t = min(s / c, 1), (n,)."""
        return np.minimum(np.maximum(np.abs(residuals) - self.spared, 0.0) / self.cutoff, 1.0)
