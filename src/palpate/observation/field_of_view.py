"""The part of the world that a later image shows: what it cuts off of the reference state is not compared."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product

import numpy as np
from numpy.typing import NDArray

from palpate.images.label_image import VoxelGrid

__all__ = ["FieldOfView", "field_of_view"]

WIDTHS = 3.0  # of the Gaussian that makes surfaces: nearer to a cut they are those of what the image continues
SAME_FIELD = 0.5  # voxels by which one image may reach beyond the other and still show the same


@dataclass(frozen=True, slots=True)
class FieldOfView:
    """Where an image shows the reference state: where inward . x >= least for every cut.

    inward (n_cuts, 3): unit normals into the image; least (n_cuts,) mm: of the cuts, the margin included.
    """

    inward: NDArray[np.float64]
    least: NDArray[np.float64]

    def shows(self, points: NDArray[np.float64]) -> NDArray[np.bool_]:
        """Which points (n, 3) in RAS mm of the later state the image shows, away from its cuts."""
        return np.asarray((points @ self.inward.T >= self.least).all(axis=1))


def field_of_view(before: VoxelGrid, after: VoxelGrid, *, smoothing_mm: float) -> FieldOfView:
    """What the later image's grid shows of the reference image's.

    Only a border that cuts something off of the reference image, by more than half a voxel, is a cut: where both end
    together, both are continued alike. What lies within three smoothing widths of a cut is not shown.
    """
    ends = np.array(list(product(*[(-0.5, n - 0.5) for n in before.shape])))
    corners = before.world(ends)
    inward, least = [], []
    for axis, direction in product(range(3), (1.0, -1.0)):
        inverse = np.linalg.inv(after.affine[:3, :3])
        normal = direction * inverse[axis] / np.linalg.norm(inverse[axis])
        last = np.full(3, 0.0)
        last[axis] = -0.5 if direction > 0.0 else after.shape[axis] - 0.5
        border = float(normal @ after.world(last[None])[0])
        if border - float((corners @ normal).min()) > SAME_FIELD * float(after.spacing[axis]):
            inward.append(normal)
            least.append(border + WIDTHS * smoothing_mm)
    return FieldOfView(np.array(inward).reshape(-1, 3), np.array(least))
