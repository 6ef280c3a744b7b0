"""Label tables whose every line has one form: colour tables of 3D Slicer and FreeSurfer, ITK-SNAP's descriptions."""

from __future__ import annotations

import re
from functools import partial
from pathlib import Path

from palpate.errors import InputDataError
from palpate.images.named_labels import NamedLabel, hex_colour
from palpate.images.readers.table_registry import TableFormat, register_table

COLOURS = r"(?P<red>[0-9]{1,3})\s+(?P<green>[0-9]{1,3})\s+(?P<blue>[0-9]{1,3})"
CTBL_ROW = re.compile(r"\s*(?P<label>[0-9]{1,9})\s+(?P<name>\S+)\s+" + COLOURS + r"(?:\s+[0-9.]{1,20})?\s*")
ITKSNAP_ROW = re.compile(
    r"\s*(?P<label>[0-9]{1,9})\s+" + COLOURS + r'\s+[0-9.eE+-]{1,20}\s+[0-9]\s+[0-9]\s+"(?P<name>[^"]*)"\s*'
)
QUOTED = re.compile(r'.*".*')


def pattern_rows(text: str, path: Path, pattern: re.Pattern[str], *, form: str) -> list[NamedLabel]:
    """Rows by the groups label, name, red, green and blue (0 to 255) of the pattern.

    Raises `InputDataError` for a line that it does not match; `form`: what the line should have been, in words.
    """
    rows = []
    for number, line in _lines(text):
        found = pattern.fullmatch(line)
        if found is None:
            raise InputDataError(
                f"line {number} of the label table '{path}' is {line[:60]!r}, not of {form}; correct it"
            )
        red, green, blue = (int(found[colour]) for colour in ("red", "green", "blue"))
        rows.append(NamedLabel(int(found["label"]), found["name"], hex_colour(red, green, blue, top=255)))
    return rows


def begins_with(text: str, pattern: re.Pattern[str]) -> bool:
    """Whether the first line that is neither blank nor a comment matches."""
    lines = _lines(text)
    return bool(lines) and pattern.fullmatch(lines[0][1]) is not None


def _lines(text: str) -> list[tuple[int, str]]:
    lines = enumerate(text.splitlines(), start=1)
    return [(number, line) for number, line in lines if line.strip() and not line.lstrip().startswith("#")]


def read_ctbl_table(text: str, path: Path) -> list[NamedLabel]:
    """Rows of a colour table, names as they stand there; `#` begins a comment.

    Raises `InputDataError` for a line of another form.
    """
    return pattern_rows(text, path, CTBL_ROW, form="the form `1 prostate 255 0 0 255` (no blank in a name)")


register_table(
    TableFormat("3D Slicer's colour table", (".ctbl", ".txt"), partial(begins_with, pattern=CTBL_ROW), read_ctbl_table)
)


def read_itksnap_table(text: str, path: Path) -> list[NamedLabel]:
    """Rows of a label description; `#` begins a comment. Raises `InputDataError` for a line of another form."""
    return pattern_rows(text, path, ITKSNAP_ROW, form='ITK-SNAP\'s form `1 255 0 0 1 1 1 "prostate"`')


register_table(
    TableFormat(
        "ITK-SNAP's label description", (".txt", ".label"), partial(begins_with, pattern=QUOTED), read_itksnap_table
    )
)
