"""Voxels as an estimate needs them: labels or intensities, reduced where they are read, axes in the order of RAS."""

from __future__ import annotations

from dataclasses import replace
from itertools import permutations
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from palpate.errors import InputDataError
from palpate.findings import Finding
from palpate.images.named_labels import MAX_LABEL
from palpate.images.readers.registry import StoredImage

MAX_SHEAR = 1e-3  # cosine between two axes; distances are computed on a rectangular grid
INTEGRAL_TOLERANCE = 1e-3  # resampling and 32-bit scaling leave 0.9999; more is a probability map or a grey image


def reduced(image: StoredImage, path: Path, *, kind: str) -> StoredImage:
    """The image with labels as `label_values`, or as "intensities": float32 in the image's own unit (HU in a CT)."""
    if kind != "labels":
        with np.errstate(over="ignore"):
            return replace(image, values=image.values.astype(np.float32, copy=False))
    slope, intercept = image.scale
    scaled = f"the header scales the stored numbers by scl_slope = {slope:g} and scl_inter = {intercept:g}"
    try:
        image = replace(image, values=label_values(image.values, path))
    except InputDataError as error:
        if image.scale == (1.0, 0.0):
            raise
        raise InputDataError(f"{error}. Also, {scaled}; labels need 1 and 0") from error
    if image.scale == (1.0, 0.0) or 0.0 < slope < 1.0:  # which programs write that scale whatever they save
        return image
    text = f"{scaled} to make labels. Set these to 1 and 0 if the stored numbers are the labels."
    return replace(image, findings=(*image.findings, Finding("scaled-labels", text)))


def label_values(values: NDArray[Any], path: Path) -> NDArray[Any]:
    """Labels (n_1, n_2, n_3) in the smallest unsigned type that holds them, from what the file `path` stores.

    Floats are rounded when they are within 1e-3 of an integer. Raises `InputDataError` for what is no label image.
    """
    if values.dtype.kind == "f":
        if lost := values.size - np.count_nonzero(np.isfinite(values)):
            flaw = f"{lost} of {values.size} voxels are NaN or infinite"
            raise InputDataError(f"'{path}' is no label image: {flaw}; give those voxels a label (0 for background)")
        whole = np.rint(values)
        away = np.abs(values - whole)
        worst = np.unravel_index(int(np.argmax(away)), values.shape)
        if away[worst] > INTEGRAL_TOLERANCE:
            flaw = f"{np.count_nonzero(away > INTEGRAL_TOLERANCE)} of {values.size} voxels are not integers"
            advice = "threshold a probability map, or resample labels with nearest neighbour"
            raise InputDataError(f"'{path}' is no label image: {flaw}, such as {values[worst]:.6g}; {advice}")
        values = whole
    low, high = values.min(), values.max()
    if low < 0 or high > MAX_LABEL:
        flaw = f"run from {low:.9g} to {high:.9g}, outside 0 to {MAX_LABEL}"
        raise InputDataError(f"the labels of '{path}' {flaw}; it may be a grey image: name the segmentation instead")
    return values.astype(np.uint8 if high <= 255 else np.uint16, copy=False)


def check_affine(affine: NDArray[np.float64], path: Path) -> None:
    """Refuse an affine (4, 4) that is not finite, flat or sheared: raises `InputDataError`."""
    advice = "repair its header (sform or qform), or export the image again"
    if not np.isfinite(affine).all():
        raise InputDataError(
            f"the header of '{path}' has an affine that is not finite, {affine[:3].tolist()}; {advice}"
        )
    with np.errstate(all="ignore"):
        spacing = np.linalg.norm(affine[:3, :3], axis=0)
        volume, box = abs(np.linalg.det(affine[:3, :3])), np.prod(spacing)
    if not spacing.min() > 0.0 or not np.isfinite(box) or volume < 1e-6 * box or volume < 1e-12:
        edges = f"voxel edges {spacing.tolist()} mm, volume {volume:.3g} mm^3"
        raise InputDataError(f"the affine in the header of '{path}' flattens the image ({edges}); {advice}")
    directions = affine[:3, :3] / spacing
    if (cosine := np.abs(directions.T @ directions - np.eye(3)).max()) > MAX_SHEAR:
        flaw = f"are not at right angles (cosine {cosine:.3g}), as after a tilted gantry"
        raise InputDataError(f"the voxel axes of '{path}' {flaw}; resample it on a rectangular grid")


def canonical(image: StoredImage) -> StoredImage:
    """The image with its axes in another order and direction, so that they run to the right, front and head.

    Of the six axis orders the one with the largest sum of direction cosines wins; a tie (a grid turned by 45 degrees)
    is broken by the resulting matrix, so that the way of storing never matters.
    """
    directions = image.affine[:3, :3] / np.linalg.norm(image.affine[:3, :3], axis=0)

    def rank(axes: tuple[int, ...]) -> tuple[float, ...]:
        """The sum of the cosines, then the matrix, rounded so that storage noise breaks no tie."""
        diagonal = np.diag(directions[:, axes])
        upright = directions[:, axes] * np.where(diagonal < 0.0, -1.0, 1.0)
        return (round(float(np.abs(diagonal).sum()), 5), *np.round(upright, 5).ravel().tolist())

    order = max(permutations(range(3)), key=rank)
    flips = directions[range(3), order] < 0.0
    values = np.flip(image.values.transpose(order), axis=tuple(np.flatnonzero(flips)))
    affine = image.affine[:, [*order, 3]] * np.where([*flips, False], -1.0, 1.0) + 0.0  # no minus zero
    affine[:3, 3] -= affine[:3, :3] @ np.where(flips, np.array(values.shape) - 1, 0)
    return replace(image, values=np.ascontiguousarray(values), affine=affine)
