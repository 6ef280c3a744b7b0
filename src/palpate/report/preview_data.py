"""What a preview draws beside what a report does: images under their labels, motion of middles, what is held."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from palpate.body.imaged import ImagedStates
from palpate.images.alignment import moved
from palpate.images.distance import smoothing_width
from palpate.images.segmentation import Segmentation
from palpate.mesh.anatomy import Box, domain_box
from palpate.report.collect import SHOWN, report_tissues
from palpate.report.report_data import (
    LaterImage,
    Reference,
    ReportData,
    SliceBox,
    TriangleSurface,
    Volume,
)
from palpate.report.surfaces import MOST_TRIANGLES, image_surface, outer_first
from palpate.report.volume import MOST_VOXELS, Grey, grey_volume, label_volume, slice_box, whole_box
from palpate.study.first_look import FrameLook, TissueLook

# One hue a role, apart on black and for the colour-blind; after Okabe & Ito, "Color Universal Design" (2008).
ROLE_COLOURS = {"estimate": "#e69f00", "driver": "#56b4e9", "known": "#2ba888", "rigid": "#cfc8b8", "void": "#6d7278"}
ALL_TRIANGLES = 240_000  # of all surfaces, so that the page stays small
RIM = 0.04  # of the longest side of an image, around it
LONGEST_ARROW_MM = 20.0  # as it is drawn


@dataclass(frozen=True, slots=True)
class PreviewImage:
    """One later image of a preview: labels and grey values of both states, and lines of what is held.

    organs, whole: labels of the first image, of this one aligned, and of this one as it lies where that is another
    place, in the box around the organs and in that of the whole image; greys: of both states, None where a case gives
    none; arrows: a tissue (index) with its middle before and after, (3,) RAS mm each; factor: how many times longer
    than it is an arrow is drawn; motion (3, 4): of the aligned surfaces back to where they lie, RAS mm; view: what
    slices of the whole show; frame, field: corners (8, 3) RAS mm of the box that is meshed, and of this image's grid.
    """

    organs: tuple[Volume, ...]
    whole: tuple[Volume, ...]
    greys: tuple[Volume | None, ...]
    arrows: tuple[tuple[int, NDArray[np.float64], NDArray[np.float64]], ...]
    factor: float
    frame: NDArray[np.float64]
    field: NDArray[np.float64]
    view: SliceBox
    motion: NDArray[np.float64] | None = None


def preview_data(
    states: ImagedStates, names: Sequence[str], document: dict[str, object], *, created: str
) -> ReportData:
    """The images of one pair as a report has them, before anything is fitted; names: of the first and later images."""
    before = states.before
    box = slice_box(before, states.after)
    n_surfaces = (1 + len(states.after)) * sum(t.role in SHOWN for t in before.tissues)
    most = min(MOST_TRIANGLES, ALL_TRIANGLES // max(n_surfaces, 1))
    voxel = float(max(image.grid.spacing.max() for image in (before, *states.after)))
    reference = Reference(
        name=names[0],
        voxel_mm=voxel,
        slices=box,
        surfaces=_surfaces(before, most),
        whole=whole_box(before, box.position),
    )
    later = tuple(
        LaterImage(name, surfaces=_surfaces(image, most)) for name, image in zip(names[1:], states.after, strict=True)
    )
    tissues = report_tissues(before.tissues, np.full(len(before.tissues), np.nan))
    return ReportData(document, created, (), tissues, "kPa", references=(reference,), later=later)


def preview_image(
    states: ImagedStates,
    after: int,
    box: SliceBox,
    looks: Sequence[TissueLook],
    frame: FrameLook,
    greys: Sequence[Grey | None],
) -> PreviewImage:
    """What is drawn of later image number `after`; greys: of the first image and of this one, brought to it."""
    before, aligned, found = states.before, states.after[after], states.later[after].alignment
    lay = None if found is None or found.still else found.motion
    images = [before, aligned, *([] if lay is None else [moved(aligned, lay)])]
    whole = whole_box(before)
    arrows = [
        (look.tissue, look.middle, look.middle + look.shifts_mm[after]) for look in looks if look.middle is not None
    ]
    longest = max((float(np.linalg.norm(end - start)) for _, start, end in arrows), default=0.0)
    rim = RIM * float((whole.high - whole.low).max())
    return PreviewImage(
        organs=tuple(label_volume(image, box) for image in images),
        whole=tuple(label_volume(image, whole) for image in images),
        greys=tuple(
            None if g is None else grey_volume(g.values, g.grid, box, most_voxels=MOST_VOXELS / 2) for g in greys
        ),
        arrows=tuple(arrows),
        factor=next((f for f in (10.0, 5.0, 3.0, 2.0) if f * longest <= LONGEST_ARROW_MM), 1.0),
        frame=_corners(frame.box),
        field=_corners(domain_box([aligned.grid])),
        view=SliceBox(whole.low - rim, whole.high + rim, whole.position),
        motion=None if lay is None else lay.matrix[:3],
    )


def _surfaces(image: Segmentation, most_triangles: int) -> tuple[TriangleSurface, ...]:
    """Surfaces of organs, drivers and bones."""
    width = smoothing_width(image.grid)
    shown = [i for i, tissue in enumerate(image.tissues) if tissue.role in SHOWN]
    found = (image_surface(image, i, smoothing_mm=width, most_triangles=most_triangles) for i in shown)
    return outer_first(found)


def _corners(box: Box) -> NDArray[np.float64]:
    """Corners (8, 3) RAS mm of a box, as their numbers count in binary along its axes."""
    return box.world(box.lengths * np.array(list(np.ndindex(2, 2, 2)), dtype=np.float64))
