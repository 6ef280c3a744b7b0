"""A folder of masks, one file an organ, as TotalSegmentator writes it; the files are named after the organs."""

from __future__ import annotations

import os
from collections.abc import Collection, Iterator
from itertools import islice
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from palpate.errors import InputDataError
from palpate.images.input_file import followed
from palpate.images.label_image import corners_apart
from palpate.images.label_table import CLASSES
from palpate.images.named_labels import NamedLabel, printable
from palpate.images.readers.dicom import refused_series
from palpate.images.readers.merged_masks import Mask, merged
from palpate.images.readers.registry import FOLDER, ImageFormat, StoredImage, format_of, marked_format, register
from palpate.images.readers.values import label_values

ENDINGS = (".nii.gz", ".nii", ".nrrd", ".nhdr", ".mha", ".mhd")
MOST_FILES = 10_000  # of any kind in the folder
MOST_MASKS = 500
MOST_LOOKED_AT = 20  # files of a folder without masks that are opened to see what they are
SAME_PLACE = 0.01  # of a voxel, at the corners: what rounding leaves


def read_mask_folder(folder: Path) -> StoredImage:
    """Read the masks in `folder`, which must lie on one grid, into one label image.

    A label's name is that of the file, its number TotalSegmentator's where it is the name of a class, else the next in
    sorted order. Raises `InputDataError` with a sentence for whatever is wrong.
    """
    found = _mask_files(folder)
    rows, files = _rows(found), [folder / name for name in found.values()]
    image = _read(files[0])
    digests: dict[str, str] = {}

    def masks() -> Iterator[Mask]:
        for row, file in zip(rows, files, strict=True):
            mask = image if file is files[0] else _read(file)
            here, there = image.values.shape, mask.values.shape
            apart, voxel = corners_apart(here, image.affine, mask.affine)
            if here != there or not apart <= SAME_PLACE * voxel:  # what is not finite is not
                how = f"their corners lie up to {apart:.3g} mm apart"
                how = how if here == there else f"{list(here)} and {list(there)} voxels"
                pair = " and ".join(f"'{printable(each.name)}'" for each in (files[0], file))
                advice = "resample them on the grid of one image, with nearest neighbour"
                raise InputDataError(f"the masks {pair} in '{folder}' are not on one grid: {how}; {advice}")
            for part, digest in mask.digests.items():
                digests[printable(f"{file.name}.{part}" if part else file.name)] = digest
            yield Mask(row, _inside(mask, file))

    labels, findings = merged(masks(), image.values.shape)
    return StoredImage(labels, image.affine, tuple(rows), digests, findings)


def _inside(mask: StoredImage, file: Path) -> NDArray[np.bool_]:
    """The voxels that are not 0, which must all have the same value."""
    labels = label_values(mask.values, file)
    inside, high = labels > 0, labels.max()
    if others := np.count_nonzero(inside & (labels != high)):
        flaw = f"of its {np.count_nonzero(inside)} voxels that are not 0, {others} have another value than {high}"
        raise InputDataError(f"'{file}' is no mask of one organ: {flaw}; name a label image by itself")
    return inside


def _mask_files(folder: Path) -> dict[str, str]:
    """The masks' files by the organs' names; other files, and those that begin with a dot, are passed over."""
    try:
        with os.scandir(folder) as entries:
            names = [entry.name for entry in islice(entries, MOST_FILES + 1)]
    except OSError as error:
        raise InputDataError(f"the folder '{folder}' cannot be read ({error}); check your right to read it") from error
    found: dict[str, str] = {}
    for name in sorted(name for name in names if not name.startswith(".")):
        stem = next((name[: -len(ending)] for ending in ENDINGS if name.lower().endswith(ending)), "")
        if stem and found.setdefault(stem, name) != name:
            raise InputDataError(f"'{folder}' has two masks of '{printable(stem)}'; take one away")
    if not found and any(marked_format(folder / name) for name in sorted(names)[:MOST_LOOKED_AT]):
        raise refused_series(folder)
    if not 1 <= len(found) <= MOST_MASKS or len(names) > MOST_FILES:
        among = str(len(names)) if len(names) <= MOST_FILES else f"over {MOST_FILES}"
        flaw = f"has {len(found)} masks ({', '.join(ENDINGS)}) among {among} files"
        raise InputDataError(f"the folder '{folder}' {flaw}; 1 to {MOST_MASKS} are read, or name a label image")
    return found


def _rows(stems: Collection[str]) -> list[NamedLabel]:
    """Numbers of the task that knows most of the names; others follow after its last class."""
    classes = max(CLASSES.values(), key=lambda known: len(known.keys() & set(stems)))
    others = [stem for stem in stems if stem not in classes]
    first = 1 if len(others) == len(stems) else len(classes) + 1
    numbers = {**classes, **{stem: number for number, stem in enumerate(others, start=first)}}
    return [NamedLabel(numbers[stem], printable(stem)) for stem in stems]


def _read(path: Path) -> StoredImage:
    file = followed(path, path.parent)
    if file is None:
        raise InputDataError(f"'{path}' is a link that leads out of its folder, which is not followed; copy the mask")
    image = format_of(file).read(file)
    if image.names:
        flaw = f"brings names of {len(image.names)} segments of its own, so it is no mask of one organ"
        raise InputDataError(f"'{path}' {flaw}; name that file as the image, or take it out of the folder")
    return image


register(ImageFormat("a folder of masks", (FOLDER,), read_mask_folder, patience=4))
