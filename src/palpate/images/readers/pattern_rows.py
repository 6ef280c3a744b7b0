"""Rows of label tables whose every line has one form; `#` begins a comment."""

from __future__ import annotations

import re
from pathlib import Path

from palpate.errors import InputDataError
from palpate.images.named_labels import NamedLabel, hex_colour

__all__ = ["COLOURS", "begins_with", "pattern_rows"]

COLOURS = r"(?P<red>[0-9]{1,3})\s+(?P<green>[0-9]{1,3})\s+(?P<blue>[0-9]{1,3})"


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
