"""What the readers of DICOM share: data sets, foreign errors as sentences, the grid of the series beside a file."""

from __future__ import annotations

import hashlib
import io
import os
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import islice
from pathlib import Path

import numpy as np
import pydicom
from pydicom.dataset import Dataset

from palpate.errors import InputDataError, PalpateError
from palpate.images.input_file import read_input, whole_input
from palpate.images.label_image import LPS_TO_RAS, VoxelGrid
from palpate.images.readers.values import to_canonical
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
    """The grid of a series, in the order closest to RAS; SHA-256 of its files and its UID, empty without a series."""

    grid: VoxelGrid
    sha256: str = ""
    uid: str = ""


@contextmanager
def sentences(path: Path) -> Iterator[None]:
    """Whatever the libraries raise becomes an `InputDataError`; their own words may quote a patient's data."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            yield
    except (PalpateError, MemoryError):
        raise
    except Exception as error:
        raise InputDataError(
            f"'{path}' is no DICOM segmentation that can be read ({type(error).__name__}); export it again"
        ) from error


def read_dataset(path: Path) -> tuple[Dataset, str]:
    """The data set in the file `path` and the SHA-256 (hexadecimal) of the file."""
    content, sha256 = whole_input(path, MOST_BYTES)
    return pydicom.dcmread(io.BytesIO(content)), sha256


def series_beside(path: Path, uids: Sequence[str]) -> Series | None:
    """The grid of the first of the series `uids` (of one, or of a slice) whose slices lie in the folder of `path`.

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
        return None
    found = list(stacks[uid].values())
    first = found[0][0]
    across, down = np.array(first.ImageOrientationPatient, dtype=np.float64).reshape(2, 3)
    places = np.array([head.ImagePositionPatient for head, _ in found], dtype=np.float64)
    order = np.argsort(places @ np.cross(across, down))
    steps = np.diff(places[order], axis=0)
    step = steps.mean(axis=0) if len(steps) else np.zeros(3)
    alike = all(head.get(name) == first.get(name) for head, _ in found for name in STACKED)
    if not alike or not len(steps) or float(np.abs(steps - step).max()) > UNEVEN * float(np.linalg.norm(step)):
        raise InputDataError(
            f"the {len(found)} slices beside '{path}' of the series that it refers to are no stack of one size and even"
            " distance; put one complete series there"
        )
    spacing = [float(number) for number in first.PixelSpacing]  # between rows, then between columns
    lps = np.eye(4)
    lps[:3, :3] = np.stack([step, down * spacing[0], across * spacing[1]], axis=1)
    lps[:3, 3] = places[order[0]]
    total = hashlib.sha256("".join(found[k][1] for k in order).encode()).hexdigest()
    shape = (len(found), int(first.Rows), int(first.Columns))
    check_size(shape, 0, path, available=0, packed=False)
    empty, affine = to_canonical(np.zeros(shape, dtype=np.uint8), LPS_AFFINE @ lps)
    return Series(VoxelGrid((empty.shape[0], empty.shape[1], empty.shape[2]), affine), total, uid)


def _files(folder: Path, depth: int = 1) -> Iterator[Path]:
    with os.scandir(folder) as entries:
        inside = sorted(entries, key=lambda entry: entry.name)
    yield from (Path(entry.path) for entry in inside if entry.is_file(follow_symlinks=False))
    for entry in inside:
        if depth and entry.is_dir(follow_symlinks=False):
            yield from _files(Path(entry.path), depth - 1)
