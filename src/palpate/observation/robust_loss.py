"""Tukey's biweight, which spares residuals as large as voxels can make them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

__all__ = ["Tukey"]


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

    def rejects(self, residuals: NDArray[np.float64]) -> NDArray[np.bool_]:
        """Which residuals (n,) mm count nothing."""
        return np.asarray(self._beyond(residuals) >= 1.0)

    def _beyond(self, residuals: NDArray[np.float64]) -> NDArray[np.float64]:
        """How far residuals lie between a and a + c: t = min(s / c, 1), (n,)."""
        return np.minimum(np.maximum(np.abs(residuals) - self.spared, 0.0) / self.cutoff, 1.0)
