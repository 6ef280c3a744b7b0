"""A label image: integers on a voxel grid with its place in the world (RAS mm)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from palpate.errors import InputDataError
from palpate.findings import Finding

LPS_TO_RAS = np.array([-1.0, -1.0, 1.0])  # signs of x, y and z, and back
NARROW = (np.uint8, np.uint16)  # an image of a whole body has half a billion voxels


@dataclass(frozen=True, slots=True)
class VoxelGrid:
    """A voxel grid: `shape` (3,) counts; `affine` (4, 4) voxel index -> RAS mm; voxel centres are at integers."""

    shape: tuple[int, int, int]
    affine: NDArray[np.float64]

    def __post_init__(self) -> None:
        affine = np.array(self.affine, dtype=np.float64)
        if affine.shape != (4, 4) or not np.isfinite(affine).all() or abs(np.linalg.det(affine[:3, :3])) < 1e-12:
            raise InputDataError(
                f"the affine {affine.tolist()} does not place a voxel grid in the world: it must be a finite,"
                " invertible 4 x 4 matrix; repair the image's header (sform or qform)"
            )
        affine.setflags(write=False)
        object.__setattr__(self, "affine", affine)

    @property
    def spacing(self) -> NDArray[np.float64]:
        """Distance between neighbouring voxel centres along each axis, (3,) mm."""
        return np.asarray(np.linalg.norm(self.affine[:3, :3], axis=0))

    @property
    def voxel_volume(self) -> float:
        """Volume of a voxel, mm^3."""
        return float(abs(np.linalg.det(self.affine[:3, :3])))

    def world(self, index: NDArray[np.float64]) -> NDArray[np.float64]:
        """RAS mm (n, 3) of voxel indices (n, 3), which need not be integers."""
        return np.asarray(index @ self.affine[:3, :3].T + self.affine[:3, 3])

    def index(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Voxel indices (n, 3), not rounded, of points (n, 3) in RAS mm."""
        inverse = np.linalg.inv(self.affine)
        return np.asarray(points @ inverse[:3, :3].T + inverse[:3, 3])


@dataclass(frozen=True, slots=True)
class LabelImage:
    """Labels (n_x, n_y, n_z) on `grid`, uint8 or uint16 where they come so, else int32.

    `names`: label -> name and `colours`: label -> #rrggbb, where given;
    `digests`: SHA-256 (hexadecimal) of each file it was read from, by its part in the image (`StoredImage`);
    `findings`: what the user should know of the reading.
    """

    labels: NDArray[np.integer[Any]]
    grid: VoxelGrid
    names: Mapping[int, str] = field(default_factory=dict)
    colours: Mapping[int, str] = field(default_factory=dict)
    digests: Mapping[str, str] = field(default_factory=dict)
    findings: tuple[Finding, ...] = ()

    def __post_init__(self) -> None:
        given = np.asarray(self.labels).dtype
        labels = np.array(self.labels, dtype=given if given in NARROW else np.int32)
        if labels.shape != self.grid.shape:
            raise InputDataError(f"labels of shape {labels.shape} do not fit the grid of shape {self.grid.shape}")
        labels.setflags(write=False)
        object.__setattr__(self, "labels", labels)
        object.__setattr__(self, "names", dict(self.names))
        object.__setattr__(self, "colours", dict(self.colours))


def corners_apart(
    shape: Sequence[float], affine: NDArray[np.float64], other: NDArray[np.float64]
) -> tuple[float, float]:
    """How far (mm) two affines (4, 4), index -> mm, place the corners of voxels of `shape` (3,) apart; a voxel's edge.

    What an affine that is not finite gives is not finite either, without a warning.
    """
    last = np.maximum(np.array(shape) - 1.0, 0.0)
    corners = np.array([[*(last * corner), 1.0] for corner in np.ndindex(2, 2, 2)])
    with np.errstate(all="ignore"):
        apart = np.linalg.norm((corners @ (affine - other).T)[:, :3], axis=1).max()
        return float(apart), float(np.linalg.norm(affine[:3, :3], axis=0).min())
