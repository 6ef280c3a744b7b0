"""Which reader opens which label table: a format is added by a file that registers it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from palpate.errors import InputDataError
from palpate.images.named_labels import NamedLabel


@dataclass(frozen=True, slots=True)
class TableFormat:
    """A table format: its name, the endings of its files, whether a text is one, and the function that reads it.

    Formats may share an ending; the first whose `recognises` says yes reads the text. `read` takes the text and the
    path (for messages); it raises `InputDataError` and lets nothing else out.
    """

    name: str
    endings: tuple[str, ...]
    recognises: Callable[[str], bool]
    read: Callable[[str, Path], list[NamedLabel]]


_FORMATS: list[TableFormat] = []


def register_table(table: TableFormat) -> None:
    """Make a table format known."""
    if table not in _FORMATS:
        _FORMATS.append(table)


def table_formats(path: Path) -> tuple[TableFormat, ...]:
    """The formats that a file's ending may stand for; raises `InputDataError` when there is none."""
    candidates = tuple(table for table in _FORMATS if path.suffix.lower() in table.endings)
    if not candidates:
        known = ", ".join(sorted({ending for table in _FORMATS for ending in table.endings}))
        raise InputDataError(
            f"no reader for the label table '{path}': the endings known are {known}; write it as JSON,"
            ' {"1": "prostate"}'
        )
    return candidates


def read_rows(text: str, path: Path, candidates: tuple[TableFormat, ...]) -> list[NamedLabel]:
    """The rows of a table by the first of the formats that knows its text; raises `InputDataError` when none does."""
    for table in candidates:
        if table.recognises(text):
            return table.read(text, path)
    names = " or ".join(table.name for table in candidates)
    raise InputDataError(
        f"the label table '{path}' does not look like {names}; export it again, or write it as JSON,"
        ' {"1": "prostate"}'
    )
