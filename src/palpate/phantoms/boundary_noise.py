"""Smooth random motion of a surface, as a segmentation by another hand or another algorithm would have it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

__all__ = ["SmoothField", "smooth_field"]

BLOCK = 4096  # points at a time: the waves of a block fit into the cache


@dataclass(frozen=True, slots=True)
class SmoothField:
    """A vector field made of plane waves.

    frequencies (n_waves, 3) rad/mm; cosines and sines (n_waves, 3) mm, the amplitude of each wave along each axis.
    """

    frequencies: NDArray[np.float64]
    cosines: NDArray[np.float64]
    sines: NDArray[np.float64]

    def at(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Field (n, 3) mm at points (n, 3) mm."""
        blocks = range(0, len(points), BLOCK)
        return np.concatenate([np.zeros((0, 3)), *(self._block(points[k : k + BLOCK]) for k in blocks)])

    def warp(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Points (n, 3) mm moved by the field."""
        return points + self.at(points)

    def _block(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        phase = points @ self.frequencies.T
        return np.asarray(np.cos(phase) @ self.cosines + np.sin(phase) @ self.sines)


def smooth_field(rng: np.random.Generator, *, sd_mm: float, correlation_mm: float, features: int = 2000) -> SmoothField:
    """A draw of a Gaussian random field with independent components.

    Each component has the standard deviation `sd_mm` (mm) and the correlation exp(-r^2 / (2 l^2)) between places r
    apart, l = `correlation_mm` (mm). Method: random Fourier features (Rahimi and Recht 2007), whose frequencies are
    normal with the standard deviation 1 / l.
    """
    scale = sd_mm / np.sqrt(features)
    frequencies = rng.normal(scale=1.0 / correlation_mm, size=(features, 3))
    cosines, sines = scale * rng.normal(size=(2, features, 3))
    return SmoothField(frequencies, cosines, sines)
