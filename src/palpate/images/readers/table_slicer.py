"""Colour tables of newer 3D Slicer: CSV with the columns LabelValue, Name, Color_R, Color_G, Color_B (0 to 255)."""

from __future__ import annotations

import csv
import io
from collections.abc import Iterable
from functools import partial
from pathlib import Path

from palpate.errors import InputDataError
from palpate.images.named_labels import NamedLabel, computed_by_spreadsheets, hex_colour
from palpate.images.readers.delimited import column_names, delimited_rows, separated_by, whole_number
from palpate.images.readers.table_registry import TableFormat, register_table

__all__ = ["read_slicer_table", "slicer_table"]

COLUMNS = ("LabelValue", "Name", "Color_R", "Color_G", "Color_B", "Color_A")


def read_slicer_table(text: str, path: Path) -> list[NamedLabel]:
    """Rows of a colour table; a missing or impossible colour is none. Raises `InputDataError` for a missing column."""
    missing = {"labelvalue", "name"} - set(column_names(text, ","))
    if missing:
        raise InputDataError(f"the label table '{path}' lacks the columns {sorted(missing)}; it needs LabelValue, Name")
    found = []
    for row in delimited_rows(text, path, delimiter=","):
        name, parts = row.get("name", ""), [row.get(f"color_{letter}", "") for letter in "rgb"]
        if name.startswith("'") and computed_by_spreadsheets(name[1:]):
            name = name[1:]
        plain = all(part.isascii() and part.isdigit() and len(part) <= 3 for part in parts)
        red, green, blue = map(int, parts) if plain else (-1, -1, -1)
        found.append(
            NamedLabel(whole_number(row.get("labelvalue", ""), path), name, hex_colour(red, green, blue, top=255))
        )
    return found


def slicer_table(rows: Iterable[NamedLabel]) -> str:
    """The text of such a table: LabelValue, Name and, where a row has one, its colour.

    A name that a spreadsheet would take for a formula gets an apostrophe in front, which reading takes away.
    """
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(COLUMNS)
    for row in rows:
        name = f"'{row.name}" if computed_by_spreadsheets(row.name) else row.name
        parts = [] if row.colour is None else [*bytes.fromhex(row.colour[1:]), 255]
        writer.writerow([row.label, name, *(parts or [""] * 4)])
    return text.getvalue()


register_table(
    TableFormat("3D Slicer's CSV colour table", (".csv",), partial(separated_by, delimiter=","), read_slicer_table)
)
