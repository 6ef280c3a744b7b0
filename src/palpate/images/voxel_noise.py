"""Where the voxels of a label image leave terraces that smoothing does not remove."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from palpate.images.distance import DistanceMap

__all__ = ["terrace_noise", "terrace_power"]

COHERENCE = 1.7  # variance times correlation area of the rounding on a patch along a grid plane, in voxel edges^4


def terrace_power(distance: DistanceMap, normals: NDArray[np.float64]) -> NDArray[np.float64]:
    """Share (n,), 0 to 1 for cubic voxels, of the rounding to whole voxels that is left in the map, as a power.

    A surface of unit normal (n, 3) tilted by t against the grid's axis a is voxelised in terraces of height h_a and
    length h_a / tan t; the Gaussian of width sigma leaves exp(-4 pi^2 sigma^2 tan^2 t / h_a^2) of their power, here
    times (h_a / h)^2, h the geometric mean of the voxel's edges. The largest of the three axes counts.
    """
    spacing = distance.grid.spacing
    axes = distance.grid.affine[:3, :3] / spacing
    cosine = np.minimum(np.abs(normals @ axes), 1.0)
    tangent2 = 1.0 / np.maximum(cosine, 1e-3) ** 2 - 1.0
    left = np.exp(-4.0 * np.pi**2 * distance.smoothing_mm**2 * tangent2 / spacing**2)
    mean = float(np.prod(spacing)) ** (1.0 / 3.0)
    return np.asarray((left * (spacing / mean) ** 2).max(axis=1))


def terrace_noise(before: DistanceMap, after: DistanceMap, normals: NDArray[np.float64]) -> NDArray[np.float64]:
    """Coherent rounding noise (n,) mm^4 of residuals at surface places with unit normals (n, 3).

    Where a surface lies along a grid plane its voxels are all wrong by the same fraction, over the whole patch, which
    no averaging over neighbours cures: variance (mm^2) times correlation area (mm^2), 1.7 h^4 (p_before + p_after) / 2.
    """
    edge = 0.5 * (before.grid.voxel_volume ** (1.0 / 3.0) + after.grid.voxel_volume ** (1.0 / 3.0))
    power = 0.5 * (terrace_power(before, normals) + terrace_power(after, normals))
    return np.asarray(COHERENCE * edge**4 * power)
