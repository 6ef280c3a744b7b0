"""What is to be meshed: a level set for every tissue and the box that cuts the body."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage, optimize

from palpate.errors import GeometryError, InputDataError
from palpate.images.distance import DistanceMap, cropped, distance_map, window_around
from palpate.images.label_image import VoxelGrid
from palpate.images.segmentation import Segmentation
from palpate.images.tissue import Role, Tissue
from palpate.parallel import mapped

ON_FACE_MM = 1e-4  # rounding in the coordinates of nodes on the faces of a box
HELD_SMOOTHING = 2.0  # factor for bones and air, whose surfaces are no data and whose roughness would cost elements
MOST_SHIFT = 0.5  # largest shift of a level, in smoothing widths
HALVINGS = 16  # bisections of the interval in which the shift is sought
CROP_MM = 24.0  # margin of a distance map around its tissue; the mesh needs no exact distances beyond


class LevelSet(Protocol):
    """A function of space that is negative inside a tissue and, near its surface, the distance to it in mm."""

    def at(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Values (n,) mm at points (n, 3) in RAS mm."""
        ...

    def gradient_at(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Gradient (n, 3), mm per mm, at points (n, 3) in RAS mm."""
        ...


@runtime_checkable
class OneLookUp(Protocol):
    """A level set that tells its value and its gradient together for little more than one of them."""

    def values_and_gradients(self, points: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Values (n,) mm and gradients (n, 3), mm per mm, at points (n, 3) in RAS mm."""
        ...


def values_and_gradients(phi: LevelSet, points: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Values (n,) mm and gradients (n, 3), mm per mm, at points (n, 3) in RAS mm."""
    if isinstance(phi, OneLookUp):
        return phi.values_and_gradients(points)
    return phi.at(points), phi.gradient_at(points)


@dataclass(frozen=True, slots=True)
class Box:
    """A box in RAS mm: corner `origin` (3,) mm, rows of `axes` (3, 3) unit vectors, `lengths` (3,) mm along them."""

    origin: NDArray[np.float64]
    axes: NDArray[np.float64]
    lengths: NDArray[np.float64]

    def __post_init__(self) -> None:
        for name in ("origin", "axes", "lengths"):
            array = np.array(getattr(self, name), dtype=np.float64)
            array.setflags(write=False)
            object.__setattr__(self, name, array)
        if self.axes.shape != (3, 3) or not np.allclose(self.axes @ self.axes.T, np.eye(3), atol=1e-6):
            raise GeometryError(f"the axes {self.axes.tolist()} of a box must be three orthogonal unit vectors in rows")
        if not (self.lengths > 0.0).all():
            raise GeometryError(
                f"a box of {np.round(self.lengths, 1).tolist()} mm is empty: do the images show the same place?"
            )

    @property
    def volume(self) -> float:
        """Volume, mm^3."""
        return float(np.prod(self.lengths))

    def local(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Coordinates (n, 3) mm along the box's axes, from its origin, of points (n, 3) in RAS mm."""
        return np.asarray((points - self.origin) @ self.axes.T)

    def faces_at(self, points: NDArray[np.float64]) -> NDArray[np.bool_]:
        """Which of its six faces (n, 6), three low ones then three high ones, points (n, 3) in RAS mm lie on."""
        local = self.local(points)
        return np.asarray(np.abs(np.concatenate([local, self.lengths - local], axis=1)) < ON_FACE_MM)

    def faces_of(self, triangles: NDArray[np.float64]) -> NDArray[np.bool_]:
        """Which of its six faces (n, 6) triangles with corners (n, 3, 3) in RAS mm lie on."""
        return np.asarray(np.all(self.faces_at(triangles.reshape(-1, 3)).reshape(-1, 3, 6), axis=1))

    def world(self, local: NDArray[np.float64]) -> NDArray[np.float64]:
        """RAS mm (n, 3) of coordinates (n, 3) mm along the box's axes."""
        return np.asarray(self.origin + local @ self.axes)


@dataclass(frozen=True, slots=True)
class Anatomy:
    """Tissues in a box, a level set each; None for the one tissue that fills what is left.

    Where level sets overlap, hollow tissues (driver, rigid, void) win over meshed ones, and of two of the same kind
    the one that comes first in `tissues`: list a tumour before the organ that surrounds it.
    """

    tissues: tuple[Tissue, ...]
    level_sets: tuple[LevelSet | None, ...]
    box: Box

    def __post_init__(self) -> None:
        fillers = [tissue.name for tissue, phi in zip(self.tissues, self.level_sets, strict=True) if phi is None]
        if len(fillers) != 1:
            raise GeometryError(
                f"an anatomy needs exactly one tissue without a level set, to fill what the others leave; got {fillers}"
            )

    @property
    def filler(self) -> int:
        """Index of the tissue that fills what is left."""
        return self.level_sets.index(None)

    @property
    def priority(self) -> tuple[int, ...]:
        """Indices of the tissues that have a level set; where two overlap, the earlier one wins."""
        return _priority(self.tissues, self.filler)

    def values(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Level sets (n_tissues - 1, n) mm, in the order of `priority`, at points (n, 3) in RAS mm."""
        chosen = [self.level_sets[i] for i in self.priority]
        return np.array([phi.at(points) for phi in chosen if phi is not None]).reshape(-1, len(points))


def anatomy_of(segmentation: Segmentation, *, box: Box, smoothing_mm: float) -> Anatomy:
    """Smooth level sets of the tissues of a label image.

    The filler is the "remaining" tissue when it is meshed, else the largest meshed one. The voxels of tissues that
    win over a tissue are first given to their nearest other neighbour, so that the tissue's surface crosses theirs
    instead of ending in a smoothed corner. `smoothing_mm`: see `images.distance.distance_map`.
    Raises `InputDataError` when a tissue has no voxel.
    """
    tissues = segmentation.tissues
    meshed = [i for i, tissue in enumerate(segmentation.tissues) if tissue.meshed]
    if not meshed:
        raise GeometryError("no tissue of the case is `estimate` or `known`: there is nothing to mesh")
    remaining = [i for i in meshed if not segmentation.tissues[i].labels]
    filler = remaining[0] if remaining else max(meshed, key=segmentation.volume)
    order = _priority(tissues, filler)

    def level_set(rank: int) -> LevelSet:
        """That of the tissue at this place of the order."""
        held = tissues[order[rank]].role in (Role.RIGID, Role.VOID)
        width = HELD_SMOOTHING * smoothing_mm if held else smoothing_mm
        tissue = order[rank]
        mask = segmentation.mask(tissue)
        if not mask.any():
            raise InputDataError(f"tissue '{segmentation.tissues[tissue].name}' has no voxel in the image")
        window = window_around(mask, segmentation.grid, reach_mm=CROP_MM)
        index, part = segmentation.index[window], mask[window]
        won = np.isin(index, order[:rank])
        if won.any() and not won.all():
            nearest = ndimage.distance_transform_edt(
                won, sampling=segmentation.grid.spacing, return_distances=False, return_indices=True
            )
            part = part[tuple(nearest)]
        return volume_preserving(distance_map(part, cropped(segmentation.grid, window), smoothing_mm=width), part)

    made = dict(zip(order, mapped(level_set, range(len(order))), strict=True))
    return Anatomy(tissues, tuple(made.get(i) for i in range(len(tissues))), box)


def domain_box(grids: Sequence[VoxelGrid]) -> Box:
    """The part common to the images, out to the outer faces of their voxels, along the first grid's axes.

    The axes stand in the order and direction of right, anterior and superior, whatever that of the voxels on disk.
    Raises `GeometryError` when the images share no volume.
    """
    u, _, vt = np.linalg.svd((grids[0].affine[:3, :3] / grids[0].spacing).T)
    axes = u @ vt  # of the nearest rotation, for an oblique header may be slightly sheared
    axes = axes[np.argsort(optimize.linear_sum_assignment(-np.abs(axes))[1])]
    axes = axes * np.sign(np.diag(axes))[:, None]
    lows, highs = [], []  # along the axes inside each grid: of one turned against them a box about its centre
    for grid in grids:
        shape = np.array(grid.shape, dtype=float)
        centre = axes @ grid.world(((shape - 1.0) / 2.0)[None])[0]
        own = 0.5 * shape * grid.spacing
        turn = np.abs((grid.affine[:3, :3] / grid.spacing).T @ axes.T)  # grid axis by box axis
        half = own[turn.argmax(axis=0)]
        half = half * min(1.0, float((own / (turn @ half)).min()) + 1e-9)
        lows.append(centre - half)
        highs.append(centre + half)
    low, high = np.max(lows, axis=0), np.min(highs, axis=0)
    return Box(low @ axes, axes, high - low)


def margin_box(box: Box, points: NDArray[np.float64], *, margin_mm: float) -> Box:
    """The part of `box` within `margin_mm` of the bounding box of points (n, 3) in RAS mm."""
    local = box.local(points)
    low = np.maximum(local.min(axis=0) - margin_mm, 0.0)
    high = np.minimum(local.max(axis=0) + margin_mm, box.lengths)
    return Box(box.world(low), box.axes, high - low)


def _priority(tissues: tuple[Tissue, ...], filler: int) -> tuple[int, ...]:
    rest = [i for i in range(len(tissues)) if i != filler]
    return tuple(sorted(rest, key=lambda i: tissues[i].meshed))


def volume_preserving(distance: DistanceMap, mask: NDArray[np.bool_]) -> DistanceMap:
    """The map shifted so that as much lies inside as the voxels of `mask` (n_x, n_y, n_z) fill.

    Smoothing with a Gaussian of width sigma moves a surface of mean curvature H inwards by sigma^2 H: a ball of 11 mm
    radius loses 5 % with sigma = 1.5 mm. The shift is at most half of sigma.
    """
    values = distance.node_values()
    edge = distance.grid.voxel_volume ** (1.0 / 3.0)
    low, high = -MOST_SHIFT * distance.smoothing_mm, MOST_SHIFT * distance.smoothing_mm
    values = values[np.abs(values) < 2.0 * (edge + high)]
    wanted = float(np.count_nonzero(mask)) - float(np.count_nonzero(distance.node_values() <= -2.0 * (edge + high)))
    for _ in range(HALVINGS):
        shift = 0.5 * (low + high)
        inside = float(np.clip(0.5 - (values + shift) / edge, 0.0, 1.0).sum())
        low, high = (low, shift) if inside < wanted else (shift, high)
    return distance.shifted(0.5 * (low + high))
