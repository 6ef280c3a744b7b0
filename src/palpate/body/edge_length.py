"""What a case meshes: the box around its organs, and edges by their thickness where the case states none."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from scipy import ndimage

from palpate.case.case import Case
from palpate.images.distance import window_around
from palpate.images.segmentation import Segmentation
from palpate.images.tissue import Role
from palpate.mechanics.dilatation import choose_element
from palpate.mesh.anatomy import Box, domain_box, margin_box

ACROSS_BALL = {Role.ESTIMATE: 5.0, Role.DRIVER: 4.0}  # edges across a ball of the tissue's volume
ACROSS_THIN = 2.5  # edges across its thickness
SURFACE_MM = 12.0**-0.5  # standard deviation of rounding to voxels of 1 mm, for which these numbers hold
FACTORS = (0.75, 1.5)  # least and largest factor on the edge length for better and worse surfaces
LEAST_MM, LEAST_VOXELS = 3.0, 2.0  # shortest edges; shorter ones cost more than they improve
LONGEST_MM = 8.0  # longest edge of a quadratic element, which has a point every 4 mm
LINEAR = 0.5  # factor for linear elements, which gives as many points as quadratic ones
STEP_MM = 0.25  # step to which the edge length is rounded
UNLIKE = 1.5  # longest over shortest edge length of organs, above which each organ has its own
MOST_VOXELS = 128  # largest number along each axis in which a thickness is measured


@dataclass(frozen=True, slots=True)
class EdgeLength:
    """Edge length (mm) at the organs, and the reason in words; longer_mm: that of organs that have a longer one."""

    mm: float
    reason: str
    longer_mm: Mapping[str, float] = field(default_factory=dict)

    @property
    def in_words(self) -> str:
        """The reason, with the longer ones."""
        return "; ".join([self.reason, *(f"{mm:g} mm at '{name}'" for name, mm in self.longer_mm.items())])


def edge_length_of(case: Case, before: Segmentation, after: Sequence[Segmentation]) -> EdgeLength:
    """The edge length of `case`; where it leaves the choice, one whose error is about a fifth of the interval at most.

    h = min_i h_i, h_i = min(d_i / n_i, t_i / 2.5) sqrt(s / s_1) over the `estimate` tissues (n = 5) and drivers (n = 4)
    of the reference state, d_i the diameter of a ball of the tissue's volume and t_i that of the largest ball inside
    it; s the standard deviation of the surfaces, by voxels v and the case's own noise, s^2 = v^2 / 12 + sd^2, and s_1
    that of voxels of 1 mm. The root is held between 0.75 and 1.5, h_i below 8 mm, h between 3 mm, or two voxels, and 8
    mm; linear elements get half of all but the former. Where the largest h_i is 1.5 h or more, each organ has its own,
    and where the case states the shortest, the others are in the same ratio to it, up to 8 mm. docs/method.md, section
    2, has the measurements.
    """
    voxel = max(image.grid.voxel_volume ** (1.0 / 3.0) for image in (before, *after))
    surface = float(np.hypot(voxel * SURFACE_MM, case.noise.surface_sd_mm or 0.0))
    order = 1.0 if choose_element(case.mechanics.element).space == "P2" else LINEAR
    factor = order * float(np.clip(np.sqrt(surface / SURFACE_MM), *FACTORS))
    longest = (order * LONGEST_MM, "the longest that still resolves an organ's surface")
    of_organs = dict[str, tuple[float, str]]()
    for i, tissue in enumerate(before.tissues):
        if tissue.role in ACROSS_BALL and (mask := before.mask(i)).any():
            ball = (6.0 * before.volume(i) / np.pi) ** (1.0 / 3.0)
            # diameter of the largest ball inside, in every second, ... voxel of a large tissue
            part = mask[window_around(mask, before.grid, reach_mm=0.0)]
            steps = [-(-n // MOST_VOXELS) for n in part.shape]
            part = np.pad(part[:: steps[0], :: steps[1], :: steps[2]], 1)
            thickness = 2.0 * float(ndimage.distance_transform_edt(part, sampling=steps * before.grid.spacing).max())
            across, thin = ACROSS_BALL[tissue.role] / factor, ACROSS_THIN / factor
            of_organs[tissue.name] = min(
                longest,
                (ball / across, f"{across:.1f} edges across '{tissue.name}', as large as a ball of {ball:.0f} mm"),
                (thickness / thin, f"{thin:.1f} edges across '{tissue.name}', {thickness:.0f} mm thick"),
            )
    mm, reason = min([longest, *of_organs.values()])
    least = max(LEAST_MM, LEAST_VOXELS * voxel)
    if mm < least:
        reason = f"the shortest that is chosen automatically; {reason} would be {mm:.1f} mm"
        mm = STEP_MM * float(np.ceil(least / STEP_MM - 1e-9))
    own = {name: h for name, (h, _) in of_organs.items()}
    own = own if max(own.values(), default=0.0) >= UNLIKE * mm else {}
    stated = case.mesh.edge_length_mm
    if stated is None:
        chosen, ratio = _rounded(mm), 1.0
    else:
        chosen, ratio, reason = stated, stated / _rounded(mm), "stated by the case"
    longer = {name: min(ratio * _rounded(h), longest[0]) for name, h in own.items()}
    return EdgeLength(chosen, reason, {name: h for name, h in longer.items() if h > chosen})


def _rounded(mm: float) -> float:
    """Down to a step."""
    return STEP_MM * float(np.floor(mm / STEP_MM + 1e-9))


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
