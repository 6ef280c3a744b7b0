"""What a case to be should mesh: a box around the organs, and an edge length for which there is the memory."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from palpate.images.label_image import LabelImage
from palpate.images.segmentation import segment
from palpate.images.tissue import Role
from palpate.study.case import REMAINING, Case, CaseTissue, Domain, Images, MeshSettings
from palpate.study.cost import MEMORY_FACTOR, cost_of_meshes, expected_size, machine_memory_gb, tets_by_edge_length
from palpate.study.edge_length import edge_length_of
from palpate.study.guess import GuessedTissue

__all__ = ["MARGIN_MM", "proposed_edge", "proposed_window"]

MARGIN_MM = 40.0
CROP_BELOW = 0.6  # a domain of the margin's box is proposed when it saves so much of the image
STEP_MM, LONGEST_MM = 0.5, 12.0  # in which edges grow until the memory does, and where that ends
SOME_KPA = 1.0  # a modulus, on which no size depends


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
