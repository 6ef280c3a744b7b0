"""Which number in our files is which tissue, as a table that 3D Slicer, spreadsheets and Palpate itself read."""

from __future__ import annotations

from pathlib import Path

from palpate.images.named_labels import NamedLabel
from palpate.images.readers.table_slicer import slicer_table
from palpate.images.segmentation import first_labels
from palpate.images.tissue import Tissue
from palpate.study.outputs import write_text

__all__ = ["write_label_table"]


def write_label_table(path: Path, tissues: tuple[Tissue, ...]) -> Path:
    """Write number, name and, where the case's label table gave one, colour of each tissue as 3D Slicer's CSV.

    Returns the path; raises `ResourceError` when the disk refuses.
    """
    labels = zip(first_labels(tissues), tissues, strict=True)
    rows = sorted((NamedLabel(int(label), t.name, t.colour) for label, t in labels), key=lambda row: row.label)
    write_text(path, slicer_table(rows))
    return path
