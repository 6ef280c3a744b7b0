"""What slices show, and where: grey images or labels, as whole numbers on a grid along the axes of the world."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from palpate.images.body_in_ct import shows_air
from palpate.images.distance import cropped, window_of
from palpate.images.label_image import VoxelGrid
from palpate.images.readers import read_intensities
from palpate.images.registration import Registration
from palpate.images.segmentation import Segmentation
from palpate.images.tissue import Role
from palpate.report.report_data import GREY_STEPS, SliceBox, Volume
from palpate.statement.result import CaseResult

MOST_VOXELS = 2_500_000  # what a page can carry and a telephone can hold
CT_WINDOW = (-160.0, 240.0)  # Hounsfield units in which soft tissues differ
CT_SPAN = (-1024.0, 3072.0)  # Hounsfield units from air to metal, which clips nothing in four to a step
MOST_TISSUES = 254
AWAY_FROM_TIES = 5e-4  # voxels: half-way between two voxels images that differ by rounding show the same one
MOST_WHOLE_GREY = 400_000  # voxels of an image that the check of the alignment shows
MARGIN_MM = 15.0
ENOUGH_VOXELS = 4_000_000
MOVING = (Role.ESTIMATE, Role.DRIVER)


def grey_volume(values: NDArray[Any], grid: VoxelGrid, box: SliceBox, *, most_voxels: float = MOST_VOXELS) -> Volume:
    """The part of a grey image (n_x, n_y, n_z) on `grid` that lies in `box`: a CT with its soft tissue in the window.

    Of another image the window is the middle 98 per cent of its values, the span all of them. It is sampled more
    coarsely than the image where it had over `most_voxels`.
    """
    step = _step(grid, box, most_voxels)
    cut = _cut(values, grid, box, step=step, order=1)
    finite = cut[np.isfinite(cut)]
    unit, span, window = "", (0.0, 1.0), (0.0, 1.0)
    if shows_air(finite):
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


@dataclass(frozen=True, slots=True)
class Grey:
    """A grey image: values (n_x, n_y, n_z) in its own unit on `grid`."""

    values: NDArray[Any]
    grid: VoxelGrid


def grey_of(path: Path, registration: Registration | None = None, *, sha256: str | None = None) -> Grey:
    """The grey image in a file, brought back as the label image beside it was; raises as `read_intensities` does."""
    values, grid = read_intensities(path, sha256=sha256)
    if registration is not None:
        grid = VoxelGrid(grid.shape, registration.motion.inverse().matrix @ grid.affine)
    return Grey(values, grid)


def earlier_grey(result: CaseResult) -> Grey | None:
    """The grey image of the reference state, if the case gives one; raises as `grey_of` does."""
    images = result.case.images
    if images is None or images.intensities_before is None:
        return None
    return grey_of(images.intensities_before, sha256=result.provenance.inputs.get("intensities_before"))


def later_grey(result: CaseResult, after: int) -> Grey | None:
    """The grey image of later image number `after`, where that was brought to; raises as `grey_of` does."""
    images = result.case.images
    if images is None or after >= len(images.intensities_after):
        return None
    digest = result.provenance.inputs.get(f"intensities_after[{after}]")
    found = result.pairs[0].later[after].alignment
    return grey_of(images.intensities_after[after], found, sha256=digest)


def background(
    result: CaseResult, grey: Grey | None, image: Segmentation, box: SliceBox, *, labels: bool = False
) -> Volume | None:
    """What the slices of an image show in `box`: its grey values; its labels where the case has no grey image; or None.

    Nothing is better than the grey values of another state under the name of this one. labels: they stand in for a grey
    image that could not be read.
    """
    images = result.case.images
    given = 0 if images is None else (images.intensities_before is not None) + len(images.intensities_after)
    if grey is not None:
        return grey_volume(grey.values, grey.grid, box, most_voxels=MOST_VOXELS / given)
    return None if given and not labels else label_volume(image, box)


def whole_box(image: Segmentation, position: NDArray[np.float64] | None = None) -> SliceBox:
    """The box around an image but for its border; the first planes go through `position` (3,) mm, or its middle.

    It begins and ends in the middle of voxels: half-way between two the one that is shown would be the rounding's, and
    another one in each image.
    """
    corners = np.array(np.meshgrid(*[[n > 3, n - 1 - (n > 3)] for n in image.grid.shape])).reshape(3, -1).T
    places = image.grid.world(corners)
    low, high = places.min(axis=0), places.max(axis=0)
    return SliceBox(low, high, 0.5 * (low + high) if position is None else position)


def whole_images(
    box: SliceBox, earlier: tuple[Segmentation, Grey | None], later: tuple[Segmentation, Grey | None]
) -> tuple[Volume, Volume]:
    """Both images in `box`, the grey values if both have them, else the labels, so that like lies over like."""
    if earlier[1] is not None and later[1] is not None:
        first, second = (
            grey_volume(grey.values, grey.grid, box, most_voxels=MOST_WHOLE_GREY) for grey in (earlier[1], later[1])
        )
        return first, second
    first, second = (label_volume(image, box, most_voxels=MOST_VOXELS) for image, _ in (earlier, later))
    return first, second


def slice_box(image: Segmentation, later: Sequence[Segmentation]) -> SliceBox:
    """A box around all estimated tissues and drivers of an image and of those brought to it, and the first planes.

    These show as much of every tissue as possible. Of an image without later ones the box is the whole of it.
    """
    moving = tuple(i for i, tissue in enumerate(image.tissues) if tissue.role in MOVING)
    boxes = []  # of each image the corners (3,) mm of the box around their voxels; the whole of it when there are none
    for each in map(_thinned, (image, *later)):
        index = np.argwhere(np.isin(each.index, moving)).astype(np.float64)
        points = each.grid.world(index if len(index) else np.array([[0.0, 0.0, 0.0], [*each.grid.shape]]))
        boxes.append((points.min(axis=0), points.max(axis=0)))
    border = np.array([_range(image.grid, axis) for axis in range(3)])
    low = np.maximum(np.min([pair[0] for pair in boxes], axis=0) - MARGIN_MM, border[:, 0])
    high = np.minimum(np.max([pair[1] for pair in boxes], axis=0) + MARGIN_MM, border[:, 1])
    before = _thinned(image)
    position = np.array([_richest(before, moving, axis) for axis in range(3)])
    return SliceBox(low, high, position) if later else whole_box(image, position)


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
