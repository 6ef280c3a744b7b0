"""A folder of masks, one file an organ, as TotalSegmentator writes it; the files are named after the organs."""

from __future__ import annotations

import os
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import islice
from pathlib import Path

import numpy as np

from palpate.errors import InputDataError
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
MOST_LOOKED_AT = 20  # files in a folder without masks: do they say what they are?
SAME_PLACE = 0.01  # of a voxel, at the corners: what rounding leaves


@dataclass(frozen=True, slots=True)
class _MaskFile:
    """A mask's row in the table of labels, its file's name and where that leads, links followed."""

    row: NamedLabel
    file: str
    target: Path


def read_mask_folder(folder: Path) -> StoredImage:
    """Read the masks in `folder`, which must lie on one grid, into one label image.

    A label's name is that of the file, its number TotalSegmentator's where it is the name of a class, else the next in
    sorted order. Raises `InputDataError` with a sentence for whatever is wrong.
    """
    files = _mask_files(folder)
    first = _read(files[0])
    digests: dict[str, str] = {}

    def masks() -> Iterator[Mask]:
        for file in files:
            image = first if file is files[0] else _read(file)
            here, there = first.values.shape, image.values.shape
            apart, voxel = corners_apart(here, first.affine, image.affine)
            if here != there or not apart <= SAME_PLACE * voxel:  # what is not finite is not
                how = f"{list(here)} and {list(there)} voxels"
                if here == there:
                    how = f"their corners lie up to {apart:.3g} mm apart"
                raise InputDataError(
                    f"the masks '{files[0].file}' and '{file.file}' in '{folder}' are not on one grid: {how}; resample"
                    " them on the grid of one image, with nearest neighbour"
                )
            for part, digest in image.digests.items():
                digests[f"{file.file}.{part}" if part else file.file] = digest
            labels = label_values(image.values, file.target)
            inside, high = labels > 0, int(labels.max())  # those that are not zero have one value, whichever it is
            others = int(np.count_nonzero(inside & (labels != high)))
            if others:
                raise InputDataError(
                    f"'{file.target}' is no mask of one organ: of its {np.count_nonzero(inside)} voxels that are not"
                    f" 0, {others} have another value than {high}; a mask has 0 and one other value. Name a label image"
                    " by itself, not in a folder of masks"
                )
            yield Mask(file.row, inside)

    labels, findings = merged(masks(), first.values.shape)
    return StoredImage(labels, first.affine, tuple(file.row for file in files), digests, findings)


def _mask_files(folder: Path) -> list[_MaskFile]:
    """The masks by their names; other files, and those that begin with a dot, are passed over."""
    try:
        with os.scandir(folder) as entries:
            names = [entry.name for entry in islice(entries, MOST_FILES + 1)]
    except OSError as error:
        raise InputDataError(f"the folder '{folder}' cannot be read ({error}); check your right to read it") from error
    found: dict[str, str] = {}
    for name in sorted(name for name in names if not name.startswith(".")):
        stem = next((name[: -len(ending)] for ending in ENDINGS if name.lower().endswith(ending)), "")
        if stem and stem in found:
            raise InputDataError(
                f"'{folder}' has two masks of '{printable(stem)}', '{printable(found[stem])}' and '{printable(name)}';"
                " take one away"
            )
        if stem:
            found[stem] = name
    if not found and any(marked_format(folder / name) for name in sorted(names)[:MOST_LOOKED_AT]):
        raise refused_series(folder)
    if not 1 <= len(found) <= MOST_MASKS or len(names) > MOST_FILES:
        raise InputDataError(
            f"the folder '{folder}' has {len(found)} masks ({', '.join(ENDINGS)}) among"
            f" {len(names) if len(names) <= MOST_FILES else f'over {MOST_FILES}'} files; 1 to {MOST_MASKS} masks in a"
            " folder of their own are read, one file an organ (prostate.nii.gz), or name a single label image"
        )
    # the labels of the task that knows most of the names; others follow after its last class
    classes = max(CLASSES.values(), key=lambda known: len(set(found) & set(known)))
    known = set(found) & set(classes)
    others = enumerate((stem for stem in found if stem not in known), start=len(classes) + 1 if known else 1)
    numbers = {stem: classes[stem] for stem in known} | {stem: number for number, stem in others}
    return [
        _MaskFile(NamedLabel(numbers[stem], printable(stem)), printable(name), _target(folder, name))
        for stem, name in found.items()
    ]


def _target(folder: Path, name: str) -> Path:
    """The file that the folder's entry leads to; raises `InputDataError` when a link leads out of the folder."""
    try:
        target = (folder / name).resolve()
        inside = target.is_relative_to(folder.resolve())
    except (OSError, RuntimeError):  # a loop of links
        inside = False
    if not inside:
        raise InputDataError(
            f"'{folder / name}' is a link that leads out of its folder, which is not followed; copy the mask into the"
            " folder"
        )
    return target


def _read(file: _MaskFile) -> StoredImage:
    image = format_of(file.target).read(file.target)
    if image.names:
        raise InputDataError(
            f"'{file.target}' brings names of {len(image.names)} segments of its own, so it is no mask of one organ;"
            " name that file as the image, or take it out of the folder"
        )
    return image


register(ImageFormat("a folder of masks", (FOLDER,), read_mask_folder, patience=4))
