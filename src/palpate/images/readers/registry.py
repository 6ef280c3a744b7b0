"""Which reader opens which file: a format is added by a file that registers it, never by editing an `if`."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from palpate.entry_points import brought
from palpate.errors import ConfigurationError, InputDataError
from palpate.findings import Finding
from palpate.images.input_file import open_input
from palpate.images.label_image import VoxelGrid
from palpate.images.named_labels import NamedLabel

FOLDER = "/"  # no file's name ends so
PAIR = (".hdr", ".img", ".hdr.gz", ".img.gz")


@dataclass(frozen=True, slots=True)
class StoredImage:
    """A file's voxels as they are stored: `values` (n_1, n_2, n_3) integers or floats, `affine` (4, 4) index -> RAS mm.

    `names`: what the file itself says of its labels. `digests`: SHA-256 (hexadecimal) of each file as it was read, by
    its part in the image: "" the file itself, "voxels" the one beside it that holds the voxels, or a file's name in a
    folder; empty when the reader does not say. `findings`: what the user should know of the reading. `scale`: slope and
    intercept by which the header makes `values` of the stored numbers.
    """

    values: NDArray[Any]
    affine: NDArray[np.float64]
    names: tuple[NamedLabel, ...] = ()
    digests: Mapping[str, str] = field(default_factory=dict)
    findings: tuple[Finding, ...] = ()
    scale: tuple[float, float] = (1.0, 0.0)

    @property
    def grid(self) -> VoxelGrid:
        """Where its voxels lie."""
        nx, ny, nz = self.values.shape
        return VoxelGrid((nx, ny, nz), self.affine)


@dataclass(frozen=True, slots=True)
class ImageFormat:
    """A file format: its name, the endings of its files (lower case, with the dot) and the function that reads one.

    `read` takes the path of an existing, non-empty file; it raises `InputDataError` and lets nothing else out. A folder
    has the ending `FOLDER`. `patience`: how many times the processor time of one file reading may take;
    `mark`: what stands at byte 128 of its files, which then need no ending; `read_on`: reads a file that may lack its
    grid (contours); `needless`: modules that its library imports where they are installed, and which no file needs.
    """

    name: str
    endings: tuple[str, ...]
    read: Callable[[Path], StoredImage]
    patience: int = 1
    mark: bytes = b""
    read_on: Callable[[Path, VoxelGrid], StoredImage] | None = None
    needless: tuple[str, ...] = ()

    def stored(self, path: Path, grid: VoxelGrid | None) -> StoredImage:
        """What `path` holds, on `grid` where the format may need one; raises as `read` does."""
        return self.read(path) if grid is None or self.read_on is None else self.read_on(path, grid)


_FORMATS: dict[str, ImageFormat] = {}


def register(image_format: ImageFormat) -> None:
    """Make a format known; raises `ConfigurationError` when another format has one of its endings."""
    for ending in image_format.endings:
        owner = _FORMATS.setdefault(ending, image_format)
        if owner is not image_format:
            text = f"the ending '{ending}' belongs to {owner.name} already"
            raise ConfigurationError(f"{text}; register {image_format.name} under another one")


@cache
def _register_brought() -> None:
    """When a file is first opened: a package may import this one to say what it brings."""
    for image_format in brought("palpate.readers", ImageFormat).values():
        register(image_format)


def format_of(path: Path) -> ImageFormat:
    """The format of a file by the longest ending that fits; raises `InputDataError` when none does.

    Raises `ConfigurationError` where another package brings a reader that cannot be used.
    """
    _register_brought()
    if os.path.isdir(path):  # noqa: PTH112 - a path that cannot be searched, or is too long, is no folder
        return _FORMATS[FOLDER]
    for ending in sorted(_FORMATS, key=len, reverse=True):
        if path.name.lower().endswith(ending):
            return _FORMATS[ending]
    if (marked := marked_format(path)) is not None:
        return marked
    half = ", which is one half of a pair (NIfTI, Analyze)" if path.name.lower().endswith(PAIR) else ""
    known = ", ".join(sorted(set(_FORMATS) - {FOLDER}))
    raise InputDataError(f"no reader for '{path}'{half}; convert it to one of {known}, or name a folder of masks")


def own_format(name: str) -> ImageFormat:
    """The format of that name which Palpate itself brings."""
    return next(each for each in _FORMATS.values() if each.name == name)


def marked_format(path: Path) -> ImageFormat | None:
    """The format whose mark the file bears, whatever its name; None when there is none, or it cannot be read."""
    try:
        with open_input(path) as file:
            begins = file.read(256)[128:]
    except (OSError, ValueError):
        return None
    return next((each for each in _FORMATS.values() if each.mark and begins.startswith(each.mark)), None)
