"""Which part of the images slices show, and where the first three lie."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from palpate.images.label_image import VoxelGrid
from palpate.images.segmentation import Segmentation
from palpate.images.tissue import Role
from palpate.report.backgrounds import whole_box
from palpate.report.report_data import SliceBox

MARGIN_MM = 15.0
ENOUGH_VOXELS = 4_000_000
MOVING = (Role.ESTIMATE, Role.DRIVER)


def slice_box(image: Segmentation, later: Sequence[Segmentation]) -> SliceBox:
    """A box around all estimated tissues and drivers of an image and of those brought to it, and the first planes.

    These show as much of every tissue as possible. Of an image without later ones the box is the whole of it.
    """
    moving = tuple(i for i, tissue in enumerate(image.tissues) if tissue.role in MOVING)
    boxes = [_extent(_thinned(each), moving) for each in (image, *later)]
    border = np.array([_range(image.grid, axis) for axis in range(3)])
    low = np.maximum(np.min([pair[0] for pair in boxes], axis=0) - MARGIN_MM, border[:, 0])
    high = np.minimum(np.max([pair[1] for pair in boxes], axis=0) + MARGIN_MM, border[:, 1])
    before = _thinned(image)
    position = np.array([_richest(before, moving, axis) for axis in range(3)])
    return SliceBox(low, high, position) if later else whole_box(image, position)


def _extent(image: Segmentation, tissues: tuple[int, ...]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Corners (3,) mm of the box around the tissues' voxels; the whole image when there are none."""
    index = np.argwhere(np.isin(image.index, tissues)).astype(np.float64)
    if not len(index):
        index = np.array([[0.0, 0.0, 0.0], [*image.grid.shape]])
    points = image.grid.world(index)
    return points.min(axis=0), points.max(axis=0)


def _thinned(image: Segmentation) -> Segmentation:
    """Every n-th voxel along each axis of a large image: enough to see where the organs are."""
    step = int(np.ceil((image.index.size / ENOUGH_VOXELS) ** (1.0 / 3.0)))
    index = image.index[::step, ::step, ::step]
    affine = image.grid.affine.copy()
    affine[:3, :3] *= step
    nx, ny, nz = index.shape
    return Segmentation(index, VoxelGrid((nx, ny, nz), affine), image.tissues)


def _richest(image: Segmentation, tissues: tuple[int, ...], axis: int) -> float:
    """Position (mm) along a world axis that shows much of every tissue, each measured by its own largest section."""
    grid = image.grid
    low, high = _range(grid, axis)
    bins = np.linspace(low, high, max(round((high - low) / float(grid.spacing.max())), 1) + 1)
    score = np.zeros(len(bins) - 1)
    for tissue in tissues:
        places = grid.world(np.argwhere(image.index == tissue).astype(np.float64))[:, axis]
        area = np.histogram(places, bins)[0]
        weight = 3.0 if image.tissues[tissue].role is Role.ESTIMATE else 1.0
        score += weight * np.log(0.03 + area / max(area.max(), 1))  # what is absent costs more than what is small
    best = int(np.argmax(score))
    return float(0.5 * (bins[best] + bins[best + 1]))


def _range(grid: VoxelGrid, axis: int) -> tuple[float, float]:
    """Outer faces of the grid along a world axis, mm."""
    corners = np.array(np.meshgrid(*[[-0.5, n - 0.5] for n in grid.shape])).reshape(3, -1).T
    places = grid.world(corners)[:, axis]
    return float(places.min()), float(places.max())
