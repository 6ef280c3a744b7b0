"""Label 0 of a case to be: how much of it lies outside the body, where nobody has labelled the body."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import ConvexHull, QhullError

from palpate.images.body_in_ct import outside_body, shows_air
from palpate.images.label_image import LabelImage, VoxelGrid

__all__ = ["Background", "background_of"]

CORNERS, SAMPLES = 20_000, 50_000  # voxels that make the hull, and that are held against it, at the most
LITTLE = 0.001  # of label 0: no air worth a tissue


@dataclass(frozen=True, slots=True)
class Background:
    """Label 0 inside the domain: its share of that, and the share of it outside the body.

    `seen`: the body was seen in a CT; else its outside is what lies beyond the convex hull of all labels, of which
    some may still be body.
    """

    share: float
    outside: float
    seen: bool

    @property
    def has_air(self) -> bool:
        """Whether a CT shows air in it that is worth a tissue."""
        return self.seen and self.outside > LITTLE

    @property
    def in_words(self) -> str:
        """What it is taken for, and how much of it may be wrong."""
        of = f"label 0 ({self.share:.0%} of what is meshed)"
        if self.seen:
            return f"{of} is air around the body for {self.outside:.1%} of its volume, by the CT; the rest is tissue"
        return (
            f"{of} is taken for tissue of the body throughout, and {self.outside:.0%} of its volume lies beyond the"
            " convex hull of all labels, where no label tells tissue from air. Air that is taken for tissue holds the"
            " organs as tissue would: give the CT (palpate init ... --ct CT), or label the body (TotalSegmentator's"
            " task body) in all images"
        )


def background_of(
    image: LabelImage, window: tuple[slice, ...], ct: tuple[NDArray[np.float32], VoxelGrid] | None
) -> Background | None:
    """Label 0 of the part `window` of `image`; `ct`: HU (nx, ny, nz) and their grid. None where there is no label 0.

    A grey image without air, as of an MR, tells nothing.
    """
    zero = image.labels[window] == 0
    if not zero.any():
        return None
    share = float(zero.mean())
    if ct is not None and shows_air(ct[0]):
        outside = outside_body(*ct, image.grid)[window]
        return Background(share, float(np.count_nonzero(outside & zero) / np.count_nonzero(zero)), seen=True)
    places = np.argwhere(zero) + np.array([s.start for s in window], dtype=np.int64)
    return Background(share, _beyond_hull(np.argwhere(image.labels != 0), places), seen=False)


def _beyond_hull(labelled: NDArray[np.int64], places: NDArray[np.int64]) -> float:
    """Share of the voxels `places` (n, 3) outside the convex hull of the voxels `labelled` (m, 3)."""
    try:
        hull = ConvexHull(labelled[:: -(-len(labelled) // CORNERS)])
    except (QhullError, ValueError):  # all in one plane
        return 1.0
    chosen = places[:: -(-len(places) // SAMPLES)]
    beyond = np.zeros(len(chosen), dtype=np.bool_)
    for *normal, offset in hull.equations:
        beyond |= chosen @ np.array(normal) + offset > 0.0
    return float(beyond.mean())
