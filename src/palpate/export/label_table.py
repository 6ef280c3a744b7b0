"""Which number in our files is which tissue, as a table that 3D Slicer, spreadsheets and Palpate itself read."""

from __future__ import annotations

from pathlib import Path

from palpate.images.named_labels import NamedLabel
from palpate.images.readers.column_tables import slicer_table
from palpate.images.segmentation import first_labels
from palpate.images.tissue import Tissue, tissue_colours
from palpate.study.outputs import write_text


def write_label_table(path: Path, tissues: tuple[Tissue, ...]) -> Path:
    """Write number, name and colour of each tissue, but for the background's, as 3D Slicer's CSV.

    Returns the path; raises `ResourceError` when the disk refuses.
    """
    described = zip(first_labels(tissues), tissues, tissue_colours(tissues), strict=True)
    rows = [NamedLabel(int(number), tissue.name, colour) for number, tissue, colour in described if number]
    write_text(path, slicer_table(sorted(rows, key=lambda row: row.label)))
    return path
