"""Colour tables of older 3D Slicer and of FreeSurfer: lines of `index name r g b a`, colours from 0 to 255."""

from __future__ import annotations

import re
from pathlib import Path

from palpate.errors import InputDataError
from palpate.images.named_labels import NamedLabel, hex_colour
from palpate.images.readers.table_registry import TableFormat, register_table

__all__ = ["read_ctbl_table"]

ROW = re.compile(r"\s*(\d{1,9})\s+(\S+)\s+(\d{1,3})\s+(\d{1,3})\s+(\d{1,3})(?:\s+[\d.]{1,20})?\s*")


def read_ctbl_table(text: str, path: Path) -> list[NamedLabel]:
    """Rows of a colour table, names as they stand there; `#` begins a comment.

    Raises `InputDataError` for a line of another form.
    """
    rows = []
    for number, line in enumerate(text.splitlines(), start=1):
        if not line.strip() or line.lstrip().startswith("#"):
            continue
        found = ROW.fullmatch(line)
        if found is None:
            raise InputDataError(
                f"line {number} of the label table '{path}' is {line[:60]!r}, not of the form"
                " `1 prostate 255 0 0 255` (no blank in a name); correct it"
            )
        red, green, blue = (int(found[k]) for k in (3, 4, 5))
        rows.append(NamedLabel(int(found[1]), found[2], hex_colour(red, green, blue, top=255)))
    return rows


def _recognised(text: str) -> bool:
    lines = (line for line in text.splitlines() if line.strip() and not line.lstrip().startswith("#"))
    return ROW.fullmatch(next(lines, "")) is not None


register_table(TableFormat("3D Slicer's colour table", (".ctbl", ".txt"), _recognised, read_ctbl_table))
