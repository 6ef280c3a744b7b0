"""Rows of tables whose columns have names and are separated by one character."""

from __future__ import annotations

import csv
import io
from collections.abc import Mapping
from pathlib import Path

from palpate.errors import InputDataError

__all__ = ["column_names", "delimited_rows", "separated_by", "whole_number"]


def column_names(text: str, delimiter: str) -> tuple[str, ...]:
    """The names in the first line, in lower case."""
    first = text.splitlines()[0] if text else ""
    return tuple(name.strip().strip('"').lower() for name in first.split(delimiter))


def separated_by(text: str, delimiter: str) -> bool:
    """Whether the first line has a delimiter."""
    return delimiter in text.partition("\n")[0]


def delimited_rows(text: str, path: Path, *, delimiter: str) -> list[Mapping[str, str]]:
    """Each line after the first: name of the column in lower case -> text. Raises `InputDataError` for damaged text."""
    names = column_names(text, delimiter)
    try:
        lines = list(csv.reader(io.StringIO(text), delimiter=delimiter))[1:]
    except csv.Error as error:
        raise InputDataError(f"the label table '{path}' is damaged: {error}; export it again") from error
    return [
        dict(zip(names, (cell.strip() for cell in line), strict=False))
        for line in lines
        if any(cell.strip() for cell in line)
    ]


def whole_number(text: str, path: Path) -> int:
    """`text` as a label; raises `InputDataError` when it is no whole number."""
    if not (text.isascii() and text.isdigit() and len(text) <= 9):
        raise InputDataError(
            f"the label table '{path}' has the label {text[:50]!r}; it must be a whole number from 0 to 65535"
        )
    return int(text)
