"""What the slices show under their lines: grey images, each in its own place, or labels where a case gives none."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from palpate.images.label_image import VoxelGrid
from palpate.images.readers import read_intensities
from palpate.images.segmentation import Segmentation
from palpate.report.report_data import SliceBox, Volume
from palpate.report.volume import MOST_VOXELS, grey_volume, label_volume
from palpate.study.result import CaseResult

MOST_WHOLE_GREY = 400_000  # voxels of an image that the check of the alignment shows


@dataclass(frozen=True, slots=True)
class Grey:
    """A grey image: values (n_x, n_y, n_z) in its own unit on `grid`."""

    values: NDArray[Any]
    grid: VoxelGrid


def earlier_grey(result: CaseResult) -> Grey | None:
    """The grey image of the reference state, if the case gives one; raises as `read_intensities` does."""
    images = result.case.images
    if images is None or images.intensities_before is None:
        return None
    digest = result.provenance.inputs.get("intensities_before")
    return Grey(*read_intensities(images.intensities_before, sha256=digest))


def later_grey(result: CaseResult, after: int) -> Grey | None:
    """The grey image of later image number `after`, where its label image was brought to.

    That is known when both have one grid; raises `ValueError` when they have not, else as `read_intensities` does.
    """
    images, aligned = result.case.images, result.after[after].grid
    if images is None or after >= len(images.intensities_after):
        return None
    digest = result.provenance.inputs.get(f"intensities_after[{after}]")
    values, grid = read_intensities(images.intensities_after[after], sha256=digest)
    if values.shape != aligned.shape or not np.allclose(grid.spacing, aligned.spacing, rtol=1e-3):
        raise ValueError("the later grey image is not on the grid of its label image")
    return Grey(values, aligned)


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
