"""The box around a case's organs that is meshed."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from palpate.images.segmentation import Segmentation
from palpate.images.tissue import Role
from palpate.mesh.anatomy import Box, domain_box, margin_box
from palpate.study.case import Case

__all__ = ["case_domain"]


def case_domain(before: Segmentation, after: Sequence[Segmentation], case: Case) -> Box:
    """The box that is meshed: what the images share, or with extent "margin" its part around organs and drivers.

    Raises `GeometryError` when the images share no volume.
    """
    box = domain_box([before.grid, *(image.grid for image in after)])
    if case.domain.extent == "image":
        return box
    shown = [i for i, tissue in enumerate(before.tissues) if tissue.role in (Role.ESTIMATE, Role.DRIVER)]
    voxels = np.argwhere(np.isin(before.index, shown)).astype(float)
    return margin_box(box, before.grid.world(voxels), margin_mm=case.domain.margin_mm)
