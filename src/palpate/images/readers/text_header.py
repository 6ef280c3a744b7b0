"""What NRRD and MetaImage share: a header of text lines, numbers in them, voxels in a file beside it."""

from __future__ import annotations

import math
import os
import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from palpate.errors import InputDataError
from palpate.images.input_file import InputFile, followed, open_input
from palpate.images.named_labels import printable
from palpate.images.readers.voxel_stream import VoxelBlock, read_block

# Not what float() takes besides: nan, inf, 1_0, digits of other scripts.
NUMBER = re.compile(r"[+-]?([0-9]{1,400}\.?[0-9]{0,400}|\.[0-9]{1,400})([eE][+-]?[0-9]{1,9})?")
MAX_LINE = 2**16
MAX_HEADER = 2**22  # bytes; a segmentation of a thousand segments has some 400 kB


def header_lines(file: InputFile, path: Path, last: str) -> list[str]:
    """The lines of a header, up to the one that the regular expression `last` finds, or the file's end.

    Raises `InputDataError` for a line or header longer than any real one.
    """
    lines: list[str] = []
    while not (lines and re.match(last, lines[-1], re.IGNORECASE)) and (line := file.readline(MAX_LINE + 1)):
        if len(line) > MAX_LINE or file.tell() > MAX_HEADER:
            flaw = f"does not end or has a line of over {MAX_LINE} bytes"
            raise InputDataError(f"the header of '{path}' {flaw}; export it again")
        lines.append(line.decode("utf-8", errors="replace").rstrip())
    return lines


def refused(path: Path, field: str, value: object, advice: str) -> InputDataError:
    """The error for a field of a header that cannot be used."""
    return InputDataError(f"the header of '{path}' has '{field}: {printable(str(value)[:60])}'; {advice}")


def numbers_in(words: Iterable[str]) -> list[float]:
    """Plain finite numbers, an empty list where one of the words is anything else."""
    found = [float(word) if NUMBER.fullmatch(word) else np.nan for word in words]
    return found if np.isfinite(found).all() else []


@dataclass(frozen=True, slots=True)
class StoredArray:
    """A file's voxels with all of its axes, `beside` those that are not in space (layers, components, time).

    `affine` (4, 4): index of the axes in space -> RAS mm; `digests`: as of `StoredImage`.
    """

    values: NDArray[Any]
    affine: NDArray[np.float64]
    beside: tuple[int, ...]
    digests: Mapping[str, str]

    def layers(self, path: Path, most: int | None = None) -> NDArray[Any]:
        """The images (n_layers, n_1, n_2, n_3); raises `InputDataError` for more than `most`, or several such axes."""
        layers = np.moveaxis(self.values, self.beside, range(len(self.beside)))
        lists = [n for n in layers.shape[:-3] if n > 1]
        if len(lists) > 1 or math.prod(lists) > (most or math.inf):
            advice = "three axes and one channel are needed; extract one volume (a time point, a channel)"
            raise refused(path, "sizes", list(self.values.shape), advice)
        return layers.reshape(-1, *layers.shape[-3:])


def voxels_of(file: InputFile, path: Path, name: str | None, block: VoxelBlock) -> tuple[NDArray[Any], dict[str, str]]:
    """The voxels (n_1, n_2, n_3), or with more axes, behind the header or in the file `name` beside it; the digests."""
    if name is None:
        return read_block(file, block, path), {"": file.sha256()}
    with open_input(_beside(path, name)) as other:
        return read_block(other, block, path), {"": file.sha256(), "voxels": other.sha256()}


def _beside(path: Path, name: str) -> Path:
    """The file `name` that holds the voxels of the header `path`; it must lie in the header's folder, links followed.

    Raises `InputDataError` when it lies elsewhere, is missing, or is a list or pattern of several files.
    """
    target = followed(path.parent / name, path.parent)
    if not name or name.upper().startswith("LIST") or "%" in name:
        flaw = "which are several files; save the image as one file (.nrrd, .mha, .nii.gz)"
    elif target is None:
        flaw = "outside its own folder, which is not followed; put both into one folder, or save the image as one file"
    elif not os.path.isfile(target):  # noqa: PTH113 - nor is a name that is too long
        flaw = "but there is no such file beside it; copy it there"
    else:
        return target
    raise InputDataError(f"'{path}' says that its voxels are in '{printable(name[:100])}', {flaw}")
