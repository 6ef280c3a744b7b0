"""The box around a case's organs that is meshed."""

from __future__ import annotations

import numpy as np
from scipy import ndimage

from palpate.images.segmentation import Segmentation
from palpate.images.tissue import Role
from palpate.mesh.anatomy import Box, domain_box, margin_box
from palpate.study.case import Case

__all__ = ["case_domain"]


def case_domain(before: Segmentation, case: Case) -> Box:
    """The box that is meshed: all that the reference image shows, or with extent "margin" its part around the organs.

    A later image with a smaller field of view shows less of it, and cuts nothing off of the body.
    """
    box = domain_box([before.grid])
    if case.domain.extent == "image":
        return box
    shown = [i for i, tissue in enumerate(before.tissues) if tissue.role in (Role.ESTIMATE, Role.DRIVER)]
    organs = np.isin(before.index, shown)
    outer = np.argwhere(organs & ~ndimage.binary_erosion(organs)).astype(float)  # those inside would be many more
    return margin_box(box, before.grid.world(outer), margin_mm=case.domain.margin_mm)
