"""Names and colours of labels, whichever table or image header they came from."""

from __future__ import annotations

import unicodedata
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

from palpate.errors import InputDataError
from palpate.findings import Finding

MAX_LABEL = 65535
MAX_NAME = 200
ROW = f"a label from 0 to {MAX_LABEL} and a name of 1 to {MAX_NAME} characters"
FORMULA = ("=", "+", "-", "@")  # a spreadsheet would compute a cell that begins so


@dataclass(frozen=True, slots=True)
class NamedLabel:
    """One line of a label table; `colour` is #rrggbb, None where the table gives none."""

    label: int
    name: str
    colour: str | None = None


@dataclass(frozen=True, slots=True, eq=False)
class LabelTable(Mapping[int, str]):
    """A label table: itself the mapping label -> name; `colours`: label -> #rrggbb where the table has one.

    `sha256`: digest (hexadecimal) of the file it was read from, empty when there is none. `findings`: what was left
    out of it.
    """

    names: Mapping[int, str] = field(default_factory=dict)
    colours: Mapping[int, str] = field(default_factory=dict)
    sha256: str = ""
    findings: tuple[Finding, ...] = ()

    def __getitem__(self, label: int) -> str:
        return self.names[label]

    def __iter__(self) -> Iterator[int]:
        return iter(self.names)

    def __len__(self) -> int:
        return len(self.names)


def checked_table(rows: Iterable[NamedLabel], path: Path) -> LabelTable:
    """The rows of the file `path` as a table sorted by label.

    Raises `InputDataError` for a label or name that is impossible or stands for two.
    """
    rows = [replace(row, name=row.name.strip()) for row in rows]
    rows = list({(row.label, row.name): row for row in reversed(rows)}.values())  # those that agree are one
    for row in rows:
        if not 0 <= row.label <= MAX_LABEL or not 1 <= len(row.name) <= MAX_NAME:
            flaw = f"has the entry {str(row.label)[:20]}: {printable(row.name[:50])!r}; it must be {ROW}"
            raise InputDataError(f"'{path}' {flaw}")
        if not row.name.isprintable():
            raise InputDataError(f"'{path}' has control characters in the name {row.name!r}; remove them")
    rows.sort(key=lambda row: row.label)
    seen: set[int | str] = set()
    for row in rows:
        if row.label in seen or row.name in seen:
            raise InputDataError(f"'{path}' names {row.label} or '{row.name}' twice; keep one of the two")
        seen |= {row.label, row.name}
    colours = {row.label: row.colour for row in rows if row.colour is not None}
    return LabelTable({row.label: row.name for row in rows}, colours)


def printable(text: str) -> str:
    """`text` for a terminal, a page or a file name: what could command one (control, bidirectional) becomes "?"."""
    return "".join(letter if letter.isprintable() else "?" for letter in text)


def given_name(text: object, otherwise: str) -> str:
    """The name that a header gives, which may be anything, as one that a label may have."""
    return printable(str(text).strip())[:MAX_NAME] or otherwise


def computed_by_spreadsheets(name: str) -> bool:
    """Whether a spreadsheet could take `name` in a CSV file for a formula, also where it splits cells at semicolons.

    Wide letters count as their plain ones, and blanks are passed over, as some spreadsheets do.
    """
    parts = unicodedata.normalize("NFKC", name).split(";")
    return any(part.strip().lstrip("'\"").startswith(FORMULA) for part in parts)


def hex_colour(parts: Sequence[float], *, top: float) -> str | None:
    """Colour #rrggbb of three components from 0 to `top`; None where they are not three, or one lies outside."""
    if len(parts) != 3 or not all(0.0 <= part <= top for part in parts):
        return None
    return "#" + "".join(f"{round(255 * part / top):02x}" for part in parts)
