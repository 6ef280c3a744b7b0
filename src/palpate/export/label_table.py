"""Which number in our files is which tissue, as a table that 3D Slicer, spreadsheets and Palpate itself read."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from palpate.images.named_labels import NamedLabel
from palpate.images.readers.table_slicer import slicer_table
from palpate.images.tissue import Tissue
from palpate.study.outputs import write_text

__all__ = ["first_labels", "write_label_table"]


def first_labels(tissues: tuple[Tissue, ...]) -> NDArray[np.int32]:
    """First label of each tissue (n_tissues,); the remaining tissue gets the smallest number that no other claims."""
    claimed = {label for tissue in tissues for label in tissue.labels}
    free = next(number for number in range(len(claimed) + 1) if number not in claimed)
    return np.array([min(tissue.labels, default=free) for tissue in tissues], dtype=np.int32)


def write_label_table(path: Path, tissues: tuple[Tissue, ...]) -> Path:
    """Write number, name and, where the case's label table gave one, colour of each tissue as 3D Slicer's CSV.

    Returns the path; raises `ResourceError` when the disk refuses.
    """
    labels = zip(first_labels(tissues), tissues, strict=True)
    rows = sorted((NamedLabel(int(label), t.name, t.colour) for label, t in labels), key=lambda row: row.label)
    write_text(path, slicer_table(rows))
    return path
