"""Filling of a hollow organ of any shape, for simulations on real anatomy."""

from __future__ import annotations

import numpy as np

from palpate.errors import GeometryError
from palpate.images.segmentation import Segmentation
from palpate.images.tissue import Role
from palpate.phantoms.boundary_noise import smooth_field
from palpate.phantoms.motion import Filling

__all__ = ["wall_filling"]

ENDS = 2.2  # half the organ's length in lengths of the filling: 9 % of it is left at the ends


def wall_filling(segmentation: Segmentation, tissue: int, *, filling_mm: float) -> Filling:
    """The filling of a tissue of the segmentation, by its index, by `filling_mm` where the organs are nearest.

    It is fullest half way from its middle to the tenth of its voxels that are nearest to the first `estimate` tissue's
    centre (in its middle when there is none).

    Its middle line is the parabola through its voxels along their longest axis (least squares), its radius that of a
    round tube with the same spread across, R^2 = 2 mean r^2. Raises `GeometryError` for a tissue of a few voxels.
    """
    voxels = segmentation.grid.world(np.argwhere(segmentation.mask(tissue)).astype(float))
    if len(voxels) < 10:
        raise GeometryError(
            f"'{segmentation.tissues[tissue].name}' has {len(voxels)} voxels: too few to fill; check its label"
        )
    centre = voxels.mean(axis=0)
    axis = np.linalg.eigh((voxels - centre).T @ (voxels - centre))[1][:, -1]
    along = (voxels - centre) @ axis
    length = float(np.abs(along).max()) / ENDS
    aside = voxels - centre - np.outer(along, axis)
    terms = np.stack([np.ones_like(along), along / length, (along / length) ** 2], axis=1)
    shift, tilt, bend = np.linalg.lstsq(terms, aside, rcond=None)[0]
    radius = float(np.sqrt(2.0 * np.mean(np.sum((aside - terms @ np.stack([shift, tilt, bend])) ** 2, axis=1))))
    fullest, estimated = 0.0, [i for i, each in enumerate(segmentation.tissues) if each.role is Role.ESTIMATE]
    if estimated:
        organ = segmentation.grid.world(np.argwhere(segmentation.mask(estimated[0])).astype(float)).mean(axis=0)
        distance = np.linalg.norm(voxels - organ, axis=1)
        fullest = 0.5 * float(along[distance <= np.quantile(distance, 0.1)].mean())
    return Filling(
        origin=centre + shift,
        axis=axis,
        bend=bend,
        radius_mm=radius,
        filling_mm=filling_mm,
        fullest_mm=fullest,
        length_mm=length,
        towards=axis,
        lean=0.0,
        stray=smooth_field(np.random.default_rng(0), sd_mm=0.0, correlation_mm=20.0, features=1),
    )
