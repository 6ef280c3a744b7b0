"""Segmentations that leave out what holds no segment, on the whole grid of the image that they were made on."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from palpate.errors import InputDataError
from palpate.findings import Finding
from palpate.images.label_image import VoxelGrid, corners_apart
from palpate.images.readers.registry import StoredImage
from palpate.images.readers.text_header import numbers_in
from palpate.images.readers.values import canonical, check_affine
from palpate.images.readers.voxel_stream import check_size

SAME_PLACE = 0.01  # of a voxel, at the corners
FARTHEST = 1e9  # mm, voxels
# Keys of 3D Slicer (vtkMRMLSegmentationStorageNode): the first voxel's index in the reference image, whose grid is
# among the parameters; files of before 2017 have an extent instead.
OFFSET, GEOMETRY, EXTENT = (
    f"Segmentation_{key}" for key in ("ReferenceImageExtentOffset", "ConversionParameters", "Extent")
)
CROPPED = "the image ends where the segments end, because 3D Slicer cropped it"
PERHAPS = "segments reach all six sides of the image, as if 3D Slicer cropped it"
ADVICE = 'Save it there without "crop to minimum extent", or name a grey image on its grid as intensities.'


def on_grid(image: StoredImage, grid: VoxelGrid | None) -> StoredImage | None:
    """The image with voxels of 0 added up to `grid`; None where its voxels are not some of that grid's."""
    first = np.zeros(3) if grid is None else np.rint(grid.index(image.affine[:3, 3][None])[0])
    last = first + image.values.shape
    if grid is None or not ((first >= 0).all() and (last <= grid.shape).all()):  # what is not finite is not
        return None
    there = grid.affine.copy()
    there[:3, 3] = grid.world(first[None])[0]
    apart, voxel = corners_apart(image.values.shape, there, image.affine)
    if not apart <= SAME_PLACE * voxel:
        return None
    whole = np.zeros(grid.shape, dtype=image.values.dtype)
    whole[tuple(slice(int(f), int(end)) for f, end in zip(first, last, strict=True))] = image.values
    return replace(image, values=whole, affine=grid.affine)


def uncropped(image: StoredImage, keys: Mapping[str, str], grid: VoxelGrid | None, path: Path) -> StoredImage:
    """A segmentation of 3D Slicer on the whole grid of its reference image, as its `keys` have it, else on `grid`.

    Where neither tells the grid of a file that was cropped, the image begins where its reference image does, ends with
    the segments, and has a finding. Raises `InputDataError` for numbers that cannot be used.
    """
    if any(numbers_in(keys.get(EXTENT, "").split())[::2]):
        raise InputDataError(f"'{path}' was cropped by a 3D Slicer of before 2017; open and save it in a newer one")
    check_affine(image.affine, path)
    reference = _reference(keys.get(GEOMETRY, ""), path)
    completed = on_grid(image, reference) or on_grid(canonical(image), grid)
    if completed or (reference is not None and _covers(image, reference)):
        return completed or image
    first = [max(int(n), 0) for n in numbers_in(keys.get(OFFSET, "").split())]
    first = first if len(first) == 3 else [0, 0, 0]
    if not any(first) and not _touched(image.values):
        return image
    check_size(tuple(n + more for n, more in zip(image.values.shape, first, strict=True)), path)
    affine = image.affine.copy()
    affine[:3, 3] -= affine[:3, :3] @ first
    finding = Finding("cropped", f"{CROPPED if any(first) else PERHAPS}. {ADVICE}")
    values = np.pad(image.values, [(n, 0) for n in first])
    return replace(image, values=values, affine=affine, findings=(*image.findings, finding))


def _reference(parameters: str, path: Path) -> VoxelGrid | None:
    """The grid in "Reference image geometry|...|": index -> RAS mm by rows, then first and last index of each axis."""
    found = re.search(r"(?:^|&)Reference image geometry\|([^|&]*)", parameters)
    numbers = numbers_in(found[1].strip("; ").split(";")) if found else []
    if len(numbers) != 22 or max(map(abs, numbers)) > FARTHEST:
        return None
    affine, extent = np.vstack([np.reshape(numbers[:12], (3, 4)), np.eye(4)[3]]), np.reshape(numbers[16:], (3, 2))
    nx, ny, nz = (int(n) for n in extent[:, 1] - extent[:, 0] + 1.0)
    if min(nx, ny, nz) < 1 or abs(np.linalg.det(affine[:3, :3])) < 1e-12:
        return None
    check_size((nx, ny, nz), path)
    affine[:3, 3] += affine[:3, :3] @ extent[:, 0]
    return VoxelGrid((nx, ny, nz), affine)


def _covers(image: StoredImage, grid: VoxelGrid) -> bool:
    """Whether no corner of the grid lies outside the image's box."""
    corners = np.array(list(np.ndindex(2, 2, 2))) * grid.shape - 0.5
    half = 0.5 * np.array(image.values.shape)
    return bool((np.abs(image.grid.index(grid.world(corners)) + 0.5 - half) <= half + SAME_PLACE).all())


def _touched(labels: NDArray[np.generic]) -> bool:
    """Whether a segment reaches each of the image's six sides, but does not fill them all."""
    sides = [side for axis in range(3) for side in (labels.take(0, axis), labels.take(-1, axis))]
    return all(side.any() for side in sides) and not all(side.all() for side in sides)
