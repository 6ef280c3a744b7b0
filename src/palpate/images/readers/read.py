"""Label images and grey images from files of any registered format."""

from __future__ import annotations

import os
import stat
from collections.abc import Mapping
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from palpate.errors import InputDataError, ResourceError
from palpate.images.input_file import similar_names
from palpate.images.label_image import LabelImage, VoxelGrid
from palpate.images.named_labels import LabelTable, checked_table
from palpate.images.readers.isolation import ReadLimits, read_stored
from palpate.images.readers.registry import FOLDER, StoredImage, format_of
from palpate.images.readers.values import canonical, check_affine, reduced

LIMITS = ReadLimits()


def read_label_image(
    path: Path | str,
    *,
    names: Mapping[int, str] | None = None,
    limits: ReadLimits | None = LIMITS,
    grid: VoxelGrid | None = None,
) -> LabelImage:
    """Read a label image, or a folder of masks; axes come in the order closest to RAS, the affine (mm) stays exact.

    Labels are integers from 0 to 65535; floats are rounded when they are within 1e-3 of one. `names` is a label table,
    used where the file brings no names of its own; `grid` is used where a DICOM segmentation lacks its series. `limits`
    are those of the process that reads; None reads here.
    Raises `InputDataError` for whatever cannot be read or is no label image, `ResourceError` when memory or time is
    short.
    """
    path = Path(path)
    stored = _read(path, "labels", limits, grid)
    own = checked_table(stored.names, path)
    table = own or (names if isinstance(names, LabelTable) else LabelTable(names or {}))
    findings = (*stored.findings, *table.findings)
    return LabelImage(stored.values, stored.grid, table.names, table.colours, stored.digests, findings)


def read_intensities(
    path: Path | str, *, limits: ReadLimits | None = LIMITS, sha256: str | None = None
) -> tuple[NDArray[np.float32], VoxelGrid]:
    """Read a grey image: intensities (n_x, n_y, n_z) float32 as the header scales them, and their grid (RAS mm).

    `sha256`: the digest of the file that is meant. Raises as `read_label_image` does, and `InputDataError` when the
    file has another digest.
    """
    stored = _read(Path(path), "intensities", limits)
    if sha256 is not None and stored.digests.get("", sha256) != sha256:
        raise InputDataError(f"'{path}' was changed after this run began; run it again with the file as it is now")
    return stored.values, stored.grid


def _read(path: Path, kind: str, limits: ReadLimits | None, grid: VoxelGrid | None = None) -> StoredImage:
    """The image in the order closest to RAS; `kind`: what its values are, "labels" or "intensities"."""
    if not path.suffix and not os.path.lexists(path):  # a folder of masks
        _check_file(path)
    image_format = format_of(path)
    if FOLDER not in image_format.endings:
        _check_file(path)
    elif kind != "labels":
        raise InputDataError(f"'{path}' is a folder, not a grey image; name the file in it")
    try:
        if limits is None:
            stored = image_format.stored(path, grid)
        else:
            stored = read_stored(path, kind, image_format, limits, grid)
        check_affine(stored.affine, path)
        return canonical(reduced(stored, path, kind=kind))
    except MemoryError as error:
        flaw = f"'{path}' does not fit into the memory of this machine"
        raise ResourceError(f"{flaw}; crop the image to the organs of the case") from error


def _check_file(path: Path) -> None:
    try:
        found = path.stat()
    except FileNotFoundError as error:
        advice = "; check the path, which in a case file or cohort table begins at that file, and whether it was moved"
        raise InputDataError(f"there is no file '{path}'{similar_names(path) or advice}") from error
    except (OSError, ValueError) as error:
        flaw = f"'{path}' cannot be opened ({error})"
        raise InputDataError(f"{flaw}; check the path and your right to read it") from error
    if not stat.S_ISREG(found.st_mode):
        raise InputDataError(f"'{path}' is a pipe, a socket or a device; save the image as a file")
    if not found.st_size:
        raise InputDataError(f"'{path}' is empty (0 bytes); export or copy the image again")
