"""What the readers of DICOM share: data sets, the grid of the series beside a file."""

from __future__ import annotations

import hashlib
import io
import os
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import islice
from pathlib import Path

import numpy as np
import pydicom
from pydicom.dataset import Dataset

from palpate.errors import InputDataError
from palpate.images.input_file import read_input, whole_input
from palpate.images.label_image import LPS_TO_RAS, VoxelGrid
from palpate.images.readers.registry import StoredImage
from palpate.images.readers.values import canonical
from palpate.images.readers.voxel_stream import check_size

LPS_AFFINE = np.diag([*LPS_TO_RAS, 1.0])
MOST_FILES = 5000  # in the folder of a segmentation and those in it
MOST_BYTES = 2**31  # of a segmentation
MOST_SLICE_BYTES = 2**26  # of another file beside it, to be one of its series
UNEVEN = 0.02  # of the distance between slices
STACKED = ("ImageOrientationPatient", "PixelSpacing", "Rows", "Columns")
PLACE = ("SeriesInstanceUID", "SOPInstanceUID", "ImagePositionPatient", *STACKED)


@dataclass(frozen=True, slots=True)
class Series:
    """The grid of a series; of one that was found its UID, and the SHA-256 of its files as digest of that part."""

    grid: VoxelGrid
    uid: str = ""
    digests: Mapping[str, str] = field(default_factory=dict)


def read_dataset(path: Path) -> tuple[Dataset, str]:
    """The data set in the file `path` and the SHA-256 (hexadecimal) of the file."""
    content, sha256 = whole_input(path, MOST_BYTES)
    return pydicom.dcmread(io.BytesIO(content)), sha256


def series_beside(path: Path, uids: Sequence[str], grid: VoxelGrid | None) -> Series | None:
    """The first of the series `uids` (of one, or of a slice) whose slices lie in the folder of `path`, else `grid`.

    Folders in it are searched, too; no link is followed. Raises `InputDataError` when the slices are no stack that is
    evenly spaced.
    """
    stacks: dict[str, dict[str, tuple[Dataset, str]]] = {}  # a slice that lies there twice counts once
    for file in islice(_files(path.parent), MOST_FILES):
        content, sha256 = read_input(file, MOST_SLICE_BYTES)
        if content[128:132] != b"DICM" or len(content) > MOST_SLICE_BYTES:
            continue
        head = pydicom.dcmread(io.BytesIO(content), stop_before_pixels=True, specific_tags=list(PLACE))
        if all(name in head for name in PLACE):
            stacks.setdefault(str(head.SeriesInstanceUID), {})[str(head.SOPInstanceUID)] = head, sha256
    uid = next((uid for each in uids for uid, stack in stacks.items() if each == uid or each in stack), None)
    if uid is None:
        return Series(grid) if grid else None
    found = list(stacks[uid].values())
    first = found[0][0]
    across, down = np.array(first.ImageOrientationPatient, dtype=np.float64).reshape(2, 3)
    places = np.array([head.ImagePositionPatient for head, _ in found], dtype=np.float64)
    order = np.argsort(places @ np.cross(across, down))
    steps = np.diff(places[order], axis=0)
    step = steps.mean(axis=0) if len(steps) else np.zeros(3)
    alike = all(head.get(name) == first.get(name) for head, _ in found for name in STACKED)
    if not alike or not len(steps) or float(np.abs(steps - step).max()) > UNEVEN * float(np.linalg.norm(step)):
        flaw = f"the {len(found)} slices of the series beside '{path}' differ in size, or are not evenly spaced"
        raise InputDataError(f"{flaw}; put one complete series there")
    between_rows, between_columns = (float(number) for number in first.PixelSpacing)
    lps = np.eye(4)
    lps[:3, :3] = np.stack([step, down * between_rows, across * between_columns], axis=1)
    lps[:3, 3] = places[order[0]]
    shape = (len(found), int(first.Rows), int(first.Columns))
    check_size(shape, path)
    digest = hashlib.sha256("".join(found[k][1] for k in order).encode()).hexdigest()
    return Series(
        canonical(StoredImage(np.zeros(shape, dtype=np.uint8), LPS_AFFINE @ lps)).grid, uid, {"series": digest}
    )


def _files(folder: Path) -> Iterator[Path]:
    """Regular files in the folder and in those in it; no link is followed."""
    for place, folders, names in os.walk(folder):
        files = (Path(place, name) for name in sorted(names))
        yield from (file for file in files if file.is_file() and not file.is_symlink())
        folders[:] = sorted(folders) if Path(place) == folder else []
