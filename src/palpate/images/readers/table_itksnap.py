"""Label descriptions of ITK-SNAP: lines of `IDX R G B A VIS MSH "LABEL"`, colours from 0 to 255."""

from __future__ import annotations

import re
from pathlib import Path

from palpate.errors import InputDataError
from palpate.images.named_labels import NamedLabel, hex_colour
from palpate.images.readers.table_registry import TableFormat, register_table

__all__ = ["read_itksnap_table"]

ROW = re.compile(r'\s*(\d{1,9})\s+(\d{1,3})\s+(\d{1,3})\s+(\d{1,3})\s+[\d.eE+-]{1,20}\s+\d\s+\d\s+"([^"]*)"\s*')


def read_itksnap_table(text: str, path: Path) -> list[NamedLabel]:
    """Rows of a label description; `#` begins a comment. Raises `InputDataError` for a line of another form."""
    rows = []
    for number, line in _lines(text):
        found = ROW.fullmatch(line)
        if found is None:
            raise InputDataError(
                f"line {number} of the label table '{path}' is {line[:60]!r}, not of ITK-SNAP's form"
                ' `1 255 0 0 1 1 1 "prostate"`; correct it'
            )
        red, green, blue = (int(found[k]) for k in (2, 3, 4))
        rows.append(NamedLabel(int(found[1]), found[5], hex_colour(red, green, blue, top=255)))
    return rows


def _lines(text: str) -> list[tuple[int, str]]:
    lines = enumerate(text.splitlines(), start=1)
    return [(number, line) for number, line in lines if line.strip() and not line.lstrip().startswith("#")]


def _recognised(text: str) -> bool:
    lines = _lines(text)
    return bool(lines) and '"' in lines[0][1]


register_table(TableFormat("ITK-SNAP's label description", (".txt", ".label"), _recognised, read_itksnap_table))
