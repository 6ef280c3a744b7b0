"""The rigid motion of a later image that was measured and removed."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from palpate.images.alignment import RigidFit, RigidMotion
from palpate.images.segmentation import Segmentation
from palpate.images.surface_alignment import SurfaceMaps, residuals_by_tissue
from palpate.images.tissue import Role, Tissue

LEAST_MM = 0.01  # no image shows less
ROUNDING = 1e-3  # mm, degrees: of a motion that a solver finds where there is none
ON = {"rigid-tissues": "the rigid tissues", "surfaces": "all surfaces that both images have"}


@dataclass(frozen=True, slots=True)
class Registration:
    """The rigid motion from the first image to a later one, and the distances that remain after it.

    by: "rigid-tissues" or "surfaces", on which it was measured; centre (3,) mm: that of the reference's organs, whose
    motion is stated; residual_mm: robust root mean square of the distance that remains between those surfaces;
    residual_by_tissue_mm: root mean square for each surface that both images show.
    """

    by: str
    motion: RigidMotion
    centre: NDArray[np.float64]
    residual_mm: float
    residual_by_tissue_mm: Mapping[str, float] = field(default_factory=dict)

    @property
    def translation_mm(self) -> NDArray[np.float64]:
        """Displacement (3,) mm of the centre of the reference's organs."""
        return np.asarray(self.motion.apply(self.centre[None])[0] - self.centre)

    @property
    def distance_mm(self) -> float:
        """Length of that displacement, mm."""
        return float(np.linalg.norm(self.translation_mm))

    @property
    def rotation_deg(self) -> float:
        """Angle of the rotation, degrees."""
        return self.motion.angle_deg

    @property
    def still(self) -> bool:
        """Whether the whole does not move, within rounding."""
        return self.distance_mm < ROUNDING and self.rotation_deg < ROUNDING

    @property
    def in_words(self) -> str:
        """Where the later image lay, on what that was measured and what was done, to follow the image's name."""
        if self.still:
            return f"was not moved: {ON[self.by]} show no clear motion of the whole"
        return (
            f"lay {self.distance_mm:.1f} mm and {self.rotation_deg:.1f} degrees away, measured on {ON[self.by]}, and"
            f" was moved back; these surfaces then lie {length_text(self.residual_mm)} mm apart"
        )

    def own_motion_mm(self, tissues: Sequence[Tissue]) -> float:
        """Motion of organs and drivers relative to the whole, mm: root mean square of their surfaces' distances."""
        moving = [tissue.name for tissue in tissues if tissue.role in (Role.ESTIMATE, Role.DRIVER)]
        kept = [mm for name, mm in self.residual_by_tissue_mm.items() if name in moving]
        return float(np.sqrt(np.mean(np.square(kept)))) if kept else 0.0

    def row(self, after: str) -> dict[str, Any]:
        """One entry of `alignment` in a JSON document; after: the later image's name."""
        return {
            "after": after,
            "by": self.by,
            "translation_mm": [round(float(part), 4) for part in self.translation_mm],
            "rotation_deg": round(self.rotation_deg, 4),
            "residual_mm": round(self.residual_mm, 4),
            "residual_by_tissue_mm": {name: round(mm, 4) for name, mm in self.residual_by_tissue_mm.items()},
        }


def length_text(mm: float) -> str:
    """A length with two digits, and nothing below 0.01 mm."""
    return f"{mm:.2g}" if mm >= LEAST_MM else f"less than {LEAST_MM:g}"


def registration(before: Segmentation, maps: SurfaceMaps, fit: RigidFit, *, by: str) -> Registration:
    """A measured motion of the organs, and the distance that remains at each surface.

    maps: as of `surface_maps`; by: "rigid-tissues" or "surfaces", on which it was measured.
    """
    organs = [i for i, tissue in enumerate(before.tissues) if tissue.role is Role.ESTIMATE]
    volumes = {organ: before.volume(organ) for organ in organs if before.mask(organ).any()}
    if volumes:
        centre = np.average([before.middle(i) for i in volumes], axis=0, weights=list(volumes.values()))
    else:
        centre = before.grid.world((np.array([before.grid.shape]) - 1.0) / 2.0)[0]
    return Registration(by, fit.motion, centre, fit.rms_mm, residuals_by_tissue(before, maps, fit.motion))
