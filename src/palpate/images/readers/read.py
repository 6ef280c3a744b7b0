"""Label images and grey images from files of any registered format."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from palpate.errors import InputDataError, ResourceError
from palpate.images.label_image import LabelImage, VoxelGrid
from palpate.images.readers.canonical import to_canonical
from palpate.images.readers.registry import format_of

__all__ = ["read_intensities", "read_label_image"]

MAX_LABEL = 65535
INTEGRAL_TOLERANCE = 1e-3  # resampling and 32-bit scaling leave 0.9999; more is a probability map or a grey image
MAX_SHEAR = 1e-3  # cosine between two axes; distances are computed on a rectangular grid


def read_label_image(path: Path | str, *, names: Mapping[int, str] | None = None) -> LabelImage:
    """Read a label image; its axes are brought to the order closest to RAS, its affine (mm) stays exact.

    Labels are integers from 0 to 65535; floats are rounded when they are within 1e-3 of one. `names` is a label table.
    Raises `InputDataError` for whatever cannot be read or is no label image, `ResourceError` when memory is short.
    """
    values, grid = _read(Path(path))
    return LabelImage(_labels(values, Path(path)), grid, names or {})


def read_intensities(path: Path | str) -> tuple[NDArray[np.float32], VoxelGrid]:
    """Read a grey image: intensities (nx, ny, nz) float32 as the header scales them, and their grid (RAS mm).

    Raises as `read_label_image` does.
    """
    values, grid = _read(Path(path))
    with np.errstate(over="ignore"):
        return values.astype(np.float32), grid


def _read(path: Path) -> tuple[NDArray[Any], VoxelGrid]:
    image_format = format_of(path)
    _check_file(path)
    try:
        stored = image_format.read(path)
        _check_affine(stored.affine, path)
        values, affine = to_canonical(stored.values, stored.affine)
    except MemoryError as error:
        raise ResourceError(
            f"'{path}' does not fit into the memory of this machine; crop the image to the organs of the case"
        ) from error
    return values, VoxelGrid((values.shape[0], values.shape[1], values.shape[2]), affine)


def _check_file(path: Path) -> None:
    try:
        if path.is_dir():
            raise InputDataError(f"'{path}' is a folder, not an image; name the file in it")
        size = path.stat().st_size
    except FileNotFoundError as error:
        raise InputDataError(
            f"there is no file '{path}'; check the path, which is relative to the case file"
        ) from error
    except (OSError, ValueError) as error:
        raise InputDataError(
            f"'{path}' cannot be opened ({error}); check the path and your right to read it"
        ) from error
    if size == 0:
        raise InputDataError(f"'{path}' is empty (0 bytes); export or copy the image again")


def _check_affine(affine: NDArray[np.float64], path: Path) -> None:
    advice = "repair its header (sform or qform), or export the image again"
    if not np.isfinite(affine).all():
        raise InputDataError(f"the header of '{path}' places the voxels at {affine[:3].tolist()}, not finite; {advice}")
    with np.errstate(over="ignore", invalid="ignore"):
        spacing = np.linalg.norm(affine[:3, :3], axis=0)
        volume = abs(np.linalg.det(affine[:3, :3]))
    if not spacing.min() > 0.0 or not np.isfinite(spacing).all() or volume < 1e-6 * np.prod(spacing) or volume < 1e-12:
        raise InputDataError(
            f"the affine in the header of '{path}', {affine[:3].tolist()}, flattens the image (voxel edges"
            f" {spacing.tolist()} mm, volume {volume:.3g} mm^3); {advice}"
        )
    cosines = (affine[:3, :3] / spacing).T @ (affine[:3, :3] / spacing) - np.eye(3)
    if np.abs(cosines).max() > MAX_SHEAR:
        raise InputDataError(
            f"the voxel axes of '{path}' are not at right angles (cosine {np.abs(cosines).max():.3g}, a tilted"
            " gantry?); resample the image on a rectangular grid"
        )


def _labels(values: NDArray[Any], path: Path) -> NDArray[np.int32]:
    if values.dtype.kind == "f":
        values = _rounded(values, path)
    low, high = values.min(), values.max()
    if low < 0 or high > MAX_LABEL:
        raise InputDataError(
            f"the labels of '{path}' run from {low:.9g} to {high:.9g}, but a label is an integer from 0 to {MAX_LABEL};"
            " is this a grey image? Name the label image (segmentation) instead, or renumber its labels"
        )
    return values.astype(np.int32)


def _rounded(values: NDArray[np.floating[Any]], path: Path) -> NDArray[np.floating[Any]]:
    lost = int(values.size - np.count_nonzero(np.isfinite(values)))
    if lost:
        raise InputDataError(
            f"'{path}' has {lost} of {values.size} voxels that are NaN or infinite; a label is an integer from 0 to"
            f" {MAX_LABEL}: give those voxels a label (0 for background)"
        )
    whole = np.rint(values)
    away = np.abs(values - whole)
    worst = np.unravel_index(int(np.argmax(away)), values.shape)
    if away[worst] > INTEGRAL_TOLERANCE:
        raise InputDataError(
            f"'{path}' is no label image: {np.count_nonzero(away > INTEGRAL_TOLERANCE)} of {values.size} voxels are not"
            f" integers, as {values[worst]:.6g}; threshold a probability map, or resample labels with nearest neighbour"
        )
    return np.asarray(whole)
