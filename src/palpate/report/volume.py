"""The images behind the slices, as whole numbers on a grid along the axes of the world."""

from __future__ import annotations

from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from palpate.images.label_image import VoxelGrid
from palpate.images.segmentation import Segmentation
from palpate.images.tissue_distance import cropped, window_of
from palpate.report.report_data import GREY_STEPS, SliceBox, Volume

MOST_VOXELS = 2_500_000  # what a page can carry and a telephone can hold
CT_WINDOW = (-160.0, 240.0)  # Hounsfield units in which soft tissues differ
CT_SPAN = (-1024.0, 3072.0)  # Hounsfield units from air to metal, which clips nothing in four to a step
CT_AIR = -500.0  # an image with less is a CT
MOST_TISSUES = 254
AWAY_FROM_TIES = 5e-4  # voxels: half-way between two voxels images that differ by rounding show the same one


def grey_volume(values: NDArray[Any], grid: VoxelGrid, box: SliceBox, *, most_voxels: float = MOST_VOXELS) -> Volume:
    """The part of a grey image (n_x, n_y, n_z) on `grid` that lies in `box`: a CT with its soft tissue in the window.

    Of another image the window is the middle 98 per cent of its values, the span all of them. It is sampled more
    coarsely than the image where it had over `most_voxels`.
    """
    step = _step(grid, box, most_voxels)
    cut = _cut(values, grid, box, step=step, order=1)
    finite = cut[np.isfinite(cut)]
    unit, span, window = "", (0.0, 1.0), (0.0, 1.0)
    if len(finite) and finite.min() < CT_AIR:
        unit, span, window = "HU", CT_SPAN, CT_WINDOW
    elif len(finite):
        least, low, high, most = np.percentile(finite, [0.0, 1.0, 99.0, 100.0]).tolist()
        window = (low, max(high, low + 1e-6))
        span = (least, max(most, window[1]))
    share = np.clip((cut - span[0]) / (span[1] - span[0]), 0.0, 1.0)
    steps = np.rint(GREY_STEPS * np.nan_to_num(share)).astype(np.uint16)
    return Volume("grey", steps, box.low, step, span, window, unit)


def label_volume(image: Segmentation, box: SliceBox, *, most_voxels: float = MOST_VOXELS) -> Volume:
    """The part of a segmentation that lies in `box`: tissue index + 1, 0 outside; sampled as above."""
    step = _step(image.grid, box, most_voxels)
    cut = _cut(image.index, image.grid, box, step=step, order=0)
    number = np.where(np.isnan(cut) | (cut >= MOST_TISSUES), -1.0, cut) + 1.0
    return Volume("labels", number.astype(np.uint16), box.low, step)


def _step(grid: VoxelGrid, box: SliceBox, most_voxels: float) -> NDArray[np.float64]:
    """Voxel edges (3,) mm: the image's finest, or coarser where the box would hold too many; they fill the box."""
    size = box.high - box.low
    edge = max(float(grid.spacing.min()), float(np.prod(size) / most_voxels) ** (1.0 / 3.0))
    return np.asarray(size / (np.maximum(np.rint(size / edge).astype(np.int64) + 1, 2) - 1))


def _cut(
    values: NDArray[Any], grid: VoxelGrid, box: SliceBox, *, step: NDArray[np.float64], order: Literal[0, 1]
) -> NDArray[np.float32]:
    """Values on the grid from `box.low` in steps of `step`; NaN outside of the image."""
    corners = np.array(np.meshgrid(*np.stack([box.low, box.high], axis=1))).reshape(3, -1).T
    window = window_of(grid.index(corners), grid, margin=1)
    part = cropped(grid, window)
    inverse = np.linalg.inv(part.affine)
    start = inverse[:3, :3] @ box.low + inverse[:3, 3] + (AWAY_FROM_TIES if order == 0 else 0.0)
    counts = np.rint((box.high - box.low) / step).astype(np.int64) + 1
    cut = ndimage.affine_transform(
        values[window].astype(np.float32),
        inverse[:3, :3] * step,
        start,
        output_shape=(int(counts[0]), int(counts[1]), int(counts[2])),
        order=order,
        mode="constant",
        cval=np.nan,
    )
    return np.asarray(cut)
