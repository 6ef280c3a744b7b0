"""Colour tables of older 3D Slicer and of FreeSurfer: lines of `index name r g b a`, colours from 0 to 255."""

from __future__ import annotations

import re
from functools import partial
from pathlib import Path

from palpate.images.named_labels import NamedLabel
from palpate.images.readers.pattern_rows import COLOURS, begins_with, pattern_rows
from palpate.images.readers.table_registry import TableFormat, register_table

__all__ = ["read_ctbl_table"]

ROW = re.compile(r"\s*(?P<label>[0-9]{1,9})\s+(?P<name>\S+)\s+" + COLOURS + r"(?:\s+[0-9.]{1,20})?\s*")


def read_ctbl_table(text: str, path: Path) -> list[NamedLabel]:
    """Rows of a colour table, names as they stand there; `#` begins a comment.

    Raises `InputDataError` for a line of another form.
    """
    return pattern_rows(text, path, ROW, form="the form `1 prostate 255 0 0 255` (no blank in a name)")


register_table(
    TableFormat("3D Slicer's colour table", (".ctbl", ".txt"), partial(begins_with, pattern=ROW), read_ctbl_table)
)
