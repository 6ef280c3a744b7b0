"""Where the body ends in a CT: what of an image is air around it, or the table that it lies on."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from palpate.errors import InputDataError
from palpate.images.label_image import VoxelGrid

AIR_HU = -400.0  # half way from air to fat and muscle
CERTAINLY_AIR_HU = -500.0  # which a CT of a body has and an MR image has not
COARSE_MM = 2.0  # coarser sampling, so that the voxels in use have about this size
THIN_MM = 4.0  # sheets of up to twice this thickness, such as tables and blankets, do not belong to the body


def outside_body(values: NDArray[np.float32], grid: VoxelGrid, on: VoxelGrid) -> NDArray[np.bool_]:
    """Which voxels (n_x, n_y, n_z) of the grid `on` lie outside the body in a CT: `values` in HU on its own `grid`.

    The body is the largest piece above -400 HU that is left when thin sheets are opened away, with the cavities that
    it encloses. What the CT does not show counts as body. Raises `InputDataError` for an image that is not in HU.
    """
    if not shows_air(values):
        raise InputDataError(
            f"the grey image has no value under {CERTAINLY_AIR_HU:g}, so it shows no air or is no CT in Hounsfield"
            " units; body_from_ct cannot find the body in it: leave it out"
        )
    step = np.maximum(np.floor(COARSE_MM / grid.spacing), 1).astype(int)
    affine = grid.affine @ np.diag([*step, 1.0])
    solid = values[:: step[0], :: step[1], :: step[2]] > AIR_HU
    reach = np.maximum(np.rint(THIN_MM / np.linalg.norm(affine[:3, :3], axis=0)), 1).astype(int)
    steps = np.meshgrid(*[np.arange(-r, r + 1) / (r + 0.5) for r in reach], indexing="ij")
    ball = np.asarray(sum(step**2 for step in steps) <= 1.0)
    around = np.pad(solid, [(r, r) for r in reach], mode="edge")  # beyond the image the body continues
    parts, count = ndimage.label(ndimage.binary_opening(around, ball))
    core = parts == 1 + np.argmax(np.bincount(parts.ravel(), minlength=2)[1:]) if count else around
    body = ndimage.binary_dilation(core, iterations=2 * int(reach.max()), mask=around)  # the corners again
    body = body[tuple(slice(r, -r) for r in reach)]
    parts, _ = ndimage.label(~body)
    faces = [np.take(parts, end, axis).ravel() for axis in range(3) for end in (0, -1)]
    reached = np.setdiff1d(np.unique(np.concatenate(faces)), [0])
    there = np.linalg.inv(affine) @ on.affine
    shown = ndimage.affine_transform(
        np.isin(parts, reached).astype(np.uint8), there[:3, :3], there[:3, 3], on.shape, order=0, mode="constant"
    )
    return np.asarray(shown > 0)


def shows_air(values: NDArray[np.float32]) -> bool:
    """Whether a grey image (n_x, n_y, n_z) has values that only air has in a CT, HU."""
    return float(values.min(initial=0.0)) < CERTAINLY_AIR_HU
