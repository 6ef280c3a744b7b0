"""What a case to be should mesh: a box around the organs, edges for which there is the memory, and how much is air."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import ConvexHull, QhullError

from palpate.body.cost import MEMORY_FACTOR, cost_of_meshes, expected_size, machine_memory_gb, tets_by_edge_length
from palpate.body.edge_length import edge_length_of
from palpate.case.case import Case, Domain, MeshSettings
from palpate.case.sources import Images
from palpate.case.tissue import REMAINING, CaseTissue
from palpate.images.body_in_ct import outside_body, shows_air
from palpate.images.label_image import LabelImage, VoxelGrid
from palpate.images.segmentation import segment
from palpate.images.tissue import Role
from palpate.study.guess import GuessedTissue

MARGIN_MM = 40.0
CROP_BELOW = 0.6  # a domain of the margin's box is proposed when it saves so much of the image
STEP_MM, LONGEST_MM = 0.5, 12.0  # in which edges grow until the memory does, and where that ends
SOME_KPA = 1.0  # a modulus, on which no size depends
CORNERS, SAMPLES = 20_000, 50_000  # voxels that make the hull, and that are held against it, at the most
LITTLE = 0.001  # of label 0: no air worth a tissue


def proposed_window(before: LabelImage, tissues: Sequence[GuessedTissue]) -> tuple[slice, ...]:
    """The voxels within `MARGIN_MM` of organs and drivers; all of them where that saves little."""
    whole = tuple(slice(0, n) for n in before.labels.shape)
    shown = [label for t in tissues if t.role in (Role.ESTIMATE, Role.DRIVER) for label in t.labels]
    places = np.argwhere(np.isin(before.labels, shown))
    if not len(places):
        return whole
    margin = MARGIN_MM / before.grid.spacing
    shape = np.array(before.labels.shape)
    low, high = np.maximum(places.min(axis=0) - margin, 0), np.minimum(places.max(axis=0) + 1 + margin, shape)
    if float(np.prod((high - low) / shape)) > CROP_BELOW:
        return whole
    return tuple(slice(int(a), int(np.ceil(b))) for a, b in zip(low, high, strict=True))


def proposed_edge(
    before: LabelImage, after: Sequence[LabelImage], tissues: Sequence[GuessedTissue], *, cropped: bool
) -> tuple[float, str] | None:
    """The edge length (mm) of a case that states none, or a longer one for which this machine has the memory; and why.

    `cropped`: whether only the margin around the organs is meshed. None where there is no organ.
    """
    if not any(t.role is Role.ESTIMATE for t in tissues):
        return None
    case = Case(  # as far as its size depends on it; a tissue without a role is taken for a known one
        id="proposed",
        images=Images(Path("before"), (Path("after"),)),
        tissues=tuple(
            CaseTissue(t.name, t.labels or REMAINING, t.role or Role.KNOWN, youngs_modulus_kpa=SOME_KPA)
            for t in tissues
        ),
        domain=Domain("margin" if cropped else "image", MARGIN_MM),
    )
    first, *later = (segment(image, case.resolve_tissues({})) for image in (before, *after))
    suited, has = edge_length_of(case, first, later), machine_memory_gb()
    edge, why = suited.mm, suited.reason
    tets = tets_by_edge_length(case, first)

    def memory_gb(edge_mm: float) -> float:
        """That an estimate with such edges needs."""
        stated = replace(case, mesh=MeshSettings(edge_mm))
        size = expected_size(case, tets(edge_length_of(stated, first, later)))
        return cost_of_meshes(case, first, [size], n_after=len(later)).memory_gb

    while has is not None and edge < LONGEST_MM and MEMORY_FACTOR * memory_gb(edge) > has:
        edge += STEP_MM
    if edge > suited.mm:
        why = f"{suited.mm:g} mm would suit the organs ({why}), but this machine has {has:.0f} GB of memory"
    return edge, why


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
            f"{of} is taken as tissue, and {self.outside:.0%} of its volume lies outside the convex hull of all labels,"
            " where it may be air. Air taken as tissue would hold the organs: give the CT (palpate init ... --ct CT),"
            " or label the body (TotalSegmentator's task body) in all images"
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
    labelled = np.argwhere(image.labels != 0)
    places = np.argwhere(zero) + np.array([s.start for s in window], dtype=np.int64)
    try:
        hull = ConvexHull(labelled[:: -(-len(labelled) // CORNERS)])
    except (QhullError, ValueError):  # all in one plane
        return Background(share, 1.0, seen=False)
    chosen = places[:: -(-len(places) // SAMPLES)]
    beyond = np.zeros(len(chosen), dtype=np.bool_)
    for *normal, offset in hull.equations:
        beyond |= chosen @ np.array(normal) + offset > 0.0
    return Background(share, float(beyond.mean()), seen=False)
