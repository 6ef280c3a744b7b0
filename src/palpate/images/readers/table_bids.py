"""Label tables of BIDS derivatives (*_dseg.tsv): columns index, name and, where given, color (#rrggbb)."""

from __future__ import annotations

import re
from functools import partial
from pathlib import Path

from palpate.errors import InputDataError
from palpate.images.named_labels import NamedLabel
from palpate.images.readers.delimited import column_names, delimited_rows, separated_by, whole_number
from palpate.images.readers.table_registry import TableFormat, register_table

__all__ = ["read_bids_table"]

COLOUR = re.compile(r"#[0-9a-f]{6}")


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
