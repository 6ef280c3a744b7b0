"""What the images show before anything is computed: how tissues move, how far they lie from what is held."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product

import numpy as np
from numpy.typing import NDArray

from palpate.body.edge_length import case_domain
from palpate.case.case import Case
from palpate.images.checks import OBSERVED, share_inside
from palpate.images.segmentation import Segmentation
from palpate.images.tissue import Role
from palpate.mesh.anatomy import Box

TOWARDS = (("left side", "right side"), ("back", "front"), ("feet", "head"))  # low and high end of each RAS axis
HELD = {
    "fixed": "The frame is held still: what the box cuts does not move.",
    "sliding": "The frame is a wall that tissues slide along: no point of it moves inwards or outwards.",
    "free": "The frame is free: nothing holds what the box cuts.",
}


@dataclass(frozen=True, slots=True)
class TissueLook:
    """A tissue (its index) in the images: volumes (mL), shifts of its middle, and the way to the frame.

    volumes_ml: in the first image, then in each later one; middle (3,) RAS mm in the first; shifts_mm: (3,) RAS mm of
    each later one, aligned; frame_mm: least distance of its voxels from the faces of the box that is meshed, in the
    direction of `towards`. Middle, shifts and distance are of organs, drivers and bones alone.
    """

    tissue: int
    volumes_ml: tuple[float, ...]
    middle: NDArray[np.float64] | None = None
    shifts_mm: tuple[NDArray[np.float64], ...] = ()
    frame_mm: float | None = None
    towards: str = ""


@dataclass(frozen=True, slots=True)
class FrameLook:
    """The box that is meshed, what holds it in words, and what of the images lies in each other.

    shared: of each later image, the share (0 to 1) of the first image that it shows, and of it that the first shows.
    """

    box: Box
    held: tuple[str, ...]
    shared: tuple[tuple[float, float], ...]


def tissue_looks(before: Segmentation, after: Sequence[Segmentation], box: Box) -> tuple[TissueLook, ...]:
    """Every tissue in an image and in those brought to it, beside the box that is meshed."""
    found = []
    for i, tissue in enumerate(before.tissues):
        volumes = tuple(image.volume(i) / 1000.0 for image in (before, *after))
        if tissue.role not in OBSERVED or not all(volumes):
            found.append(TissueLook(i, volumes))
            continue
        middle = before.middle(i)
        shifts = tuple(image.middle(i) - middle for image in after)
        low, high = np.full(3, np.inf), np.full(3, -np.inf)  # of its voxels along the box
        for voxels in before.voxels(i):
            if len(voxels):
                local = box.local(before.grid.world(voxels.astype(np.float64)))
                low, high = np.minimum(low, local.min(axis=0)), np.maximum(high, local.max(axis=0))
        ways = [
            (low[a], -box.axes[a]) if end else (box.lengths[a] - high[a], box.axes[a])
            for a, end in product(range(3), (1, 0))
        ]
        distance, direction = min(ways, key=lambda way: float(way[0]))
        axis = int(np.argmax(np.abs(direction)))
        towards = TOWARDS[axis][int(direction[axis] > 0.0)]
        frame_mm = max(float(distance) - 0.5 * float(before.grid.spacing.max()), 0.0)
        found.append(TissueLook(i, volumes, middle, shifts, frame_mm, towards))
    return tuple(found)


def frame_look(case: Case, before: Segmentation, after: Sequence[Segmentation]) -> FrameLook:
    """The frame of a case and what its images share."""
    shared = tuple((share_inside(before.grid, i.grid), share_inside(i.grid, before.grid)) for i in after)
    box, domain = case_domain(before, case), case.domain
    size = " × ".join(f"{length:.0f}" for length in box.lengths)
    shown = {"margin": f"{domain.margin_mm:g} mm around organs and drivers"}
    around = shown.get(domain.extent, "all that the first image shows")
    held = [f"The mesh fills a box of {size} mm, {around}. Its faces are the frame."]
    names = {role: [t.name for t in case.tissues if t.role is role] for role in Role}
    if domain.outer_boundary == "moving":
        held.append(
            f"The frame, where the box cuts the body, may move: each point by about {domain.outer_motion_mm:g} mm,"
            f" alike over {domain.outer_kernel_mm:g} mm. The images decide how far it does."
        )
    else:
        held.append(HELD[domain.outer_boundary])
    if names[Role.RIGID]:
        held.append(
            f"Rigid: {', '.join(names[Role.RIGID])}. Each moves as one body by what the images show, and its surface"
            " holds what touches it."
        )
    if names[Role.DRIVER]:
        drivers = ", ".join(names[Role.DRIVER])
        held.append(f"Driver: {drivers}. The motion of its wall moves the others; it is found from the images.")
    if names[Role.VOID]:
        held.append(f"Void: {', '.join(names[Role.VOID])}. Its surface is free.")
    return FrameLook(box, tuple(held), shared)
