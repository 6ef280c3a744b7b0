"""Label tables whose columns have names: *_dseg.tsv of BIDS derivatives, and CSV colour tables of newer 3D Slicer."""

from __future__ import annotations

import csv
import io
import re
from collections.abc import Iterable, Mapping
from functools import partial
from pathlib import Path

from palpate.errors import InputDataError
from palpate.images.named_labels import NamedLabel, computed_by_spreadsheets, hex_colour
from palpate.images.readers.table_registry import TableFormat, register_table

COLOUR = re.compile(r"#[0-9a-f]{6}")
COLUMNS = ("LabelValue", "Name", "Color_R", "Color_G", "Color_B", "Color_A")


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


def read_bids_table(text: str, path: Path) -> list[NamedLabel]:
    """Rows of a dseg.tsv; "n/a" is no colour. Raises `InputDataError` for a missing column."""
    missing = {"index", "name"} - set(column_names(text, "\t"))
    if missing:
        raise InputDataError(f"the label table '{path}' lacks the columns {sorted(missing)}; it needs index and name")
    rows = []
    for row in delimited_rows(text, path, delimiter="\t"):
        colour = row.get("color", "").lower()
        label = whole_number(row.get("index", ""), path)
        rows.append(NamedLabel(label, row.get("name", ""), colour if COLOUR.fullmatch(colour) else None))
    return rows


register_table(TableFormat("a BIDS dseg.tsv", (".tsv",), partial(separated_by, delimiter="\t"), read_bids_table))


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
