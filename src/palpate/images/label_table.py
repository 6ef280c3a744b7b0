"""Label tables: which number of a label image is which organ, and its colour.

JSON: {"1": "prostate"}, {"prostate": 1}, or either under "labels" (nnU-Net, TotalSegmentator). Named columns:
*_dseg.tsv of BIDS derivatives, CSV colour tables of newer 3D Slicer. Lines of one form: colour tables of 3D Slicer and
FreeSurfer, ITK-SNAP's descriptions.
"""

from __future__ import annotations

import csv
import io
import json
import re
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, replace
from functools import partial
from importlib import resources
from pathlib import Path
from typing import Any

from palpate.errors import InputDataError
from palpate.images.input_file import read_input
from palpate.images.named_labels import (
    MAX_LABEL,
    MAX_NAME,
    LabelTable,
    NamedLabel,
    checked_table,
    computed_by_spreadsheets,
    hex_colour,
)

# The classes of TotalSegmentator's tasks `total` (version 2, CT) and `total_mr`: facts, from its table `class_map`
# (https://github.com/wasserth/TotalSegmentator, totalsegmentator/map_to_binary.py). A class's number is its place in
# the list, from 1. No class of either task is the rectum.
TOTALSEGMENTATOR = resources.files("palpate.images") / "totalsegmentator.json"
CLASSES: Mapping[str, Mapping[str, int]] = {
    task: {name: number for number, name in enumerate(names, start=1)}
    for task, names in json.loads(TOTALSEGMENTATOR.read_text("utf-8")).items()
}
MAX_BYTES = 2**20
COLOUR = re.compile(r"#[0-9a-f]{6}")
COLUMNS = ("LabelValue", "Name", "Color_R", "Color_G", "Color_B", "Color_A")
DIGITS = re.compile(r"[0-9]{1,9}")  # not what int() takes besides: blanks, signs, 1_0, digits of other scripts
COLOURS = r"(?P<red>[0-9]{1,3})\s+(?P<green>[0-9]{1,3})\s+(?P<blue>[0-9]{1,3})"
CTBL_ROW = re.compile(r"\s*(?P<label>[0-9]{1,9})\s+(?P<name>\S+)\s+" + COLOURS + r"(?:\s+[0-9.]{1,20})?\s*")
ITKSNAP_ROW = re.compile(
    r"\s*(?P<label>[0-9]{1,9})\s+" + COLOURS + r'\s+[0-9.eE+-]{1,20}\s+[0-9]\s+[0-9]\s+"(?P<name>[^"]*)"\s*'
)
QUOTED = re.compile(r'.*".*')


@dataclass(frozen=True, slots=True)
class TableFormat:
    """A table format: its name, the endings of its files, whether a text is one, and the function that reads one.

    Formats may share an ending; the first whose `recognises` says yes reads the text. `read` takes the text and the
    path (for messages); it raises `InputDataError` and lets nothing else out.
    """

    name: str
    endings: tuple[str, ...]
    recognises: Callable[[str], bool]
    read: Callable[[str, Path], list[NamedLabel]]


def read_label_table(path: Path | str) -> LabelTable:
    """Read a label table: label (0 to 65535) -> name, sorted by label, with `colours` (#rrggbb) where it has them.

    JSON, ITK-SNAP's label description (.txt, .label), 3D Slicer's colour tables (.csv, .ctbl, .txt), BIDS dseg.tsv.
    Raises `InputDataError` for a file that cannot be read, or a label or name that is impossible or given twice.
    """
    path = Path(path)
    candidates = [table for table in TABLES if path.suffix.lower() in table.endings]
    if not candidates:
        known = ", ".join(sorted({ending for table in TABLES for ending in table.endings}))
        raise InputDataError(
            f"no reader for the label table '{path}': the endings known are {known}; write it as JSON,"
            ' {"1": "prostate"}'
        )
    try:
        content, sha256 = read_input(path, MAX_BYTES)
    except (OSError, ValueError) as error:
        raise InputDataError(f"the label table '{path}' cannot be read ({error}); check the path") from error
    if len(content) > MAX_BYTES:
        raise InputDataError(f"the label table '{path}' is larger than {MAX_BYTES} bytes; is it another file?")
    try:
        text = content.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise InputDataError(f"the label table '{path}' is not UTF-8 text ({error}); save it as UTF-8") from error
    reader = next((table for table in candidates if table.recognises(text)), None)
    if reader is None:
        names = " or ".join(table.name for table in candidates)
        raise InputDataError(
            f"the label table '{path}' does not look like {names}; export it again, or write it as JSON,"
            ' {"1": "prostate"}'
        )
    table = checked_table(reader.read(text, path), path)
    if not table:
        raise InputDataError(f"the label table '{path}' names no label; is it another file?")
    return replace(table, sha256=sha256)


def _delimited(text: str, path: Path, *, delimiter: str, needs: str) -> list[dict[str, str]]:
    """Each line after the first that is not blank: name of the column in lower case -> text.

    Raises `InputDataError` for damaged text and where a column of `needs` is missing.
    """
    try:
        names, *lines = csv.reader(io.StringIO(text), delimiter=delimiter)
    except csv.Error as error:
        raise InputDataError(f"the label table '{path}' is damaged: {error}; export it again") from error
    names = [name.strip().lower() for name in names]
    missing = set(needs.lower().split(", ")) - set(names)
    if missing:
        raise InputDataError(f"the label table '{path}' lacks the columns {sorted(missing)}; it needs {needs}")
    cells = [[cell.strip() for cell in line] for line in lines]
    return [dict.fromkeys(names, "") | dict(zip(names, line, strict=False)) for line in cells if any(line)]


def _label(text: str, path: Path) -> int:
    if not DIGITS.fullmatch(text):
        raise InputDataError(
            f"the label table '{path}' has the label {text[:50]!r}; it must be a whole number from 0 to 65535"
        )
    return int(text)


def read_bids_table(text: str, path: Path) -> list[NamedLabel]:
    """Rows of a dseg.tsv; "n/a" is no colour. Raises `InputDataError` for a missing column."""
    rows = []
    for row in _delimited(text, path, delimiter="\t", needs="index, name"):
        colour = row.get("color", "").lower()
        rows.append(NamedLabel(_label(row["index"], path), row["name"], colour if COLOUR.fullmatch(colour) else None))
    return rows


def read_slicer_table(text: str, path: Path) -> list[NamedLabel]:
    """Rows of a colour table; a missing or impossible colour is none. Raises `InputDataError` for a missing column."""
    found = []
    for row in _delimited(text, path, delimiter=",", needs="LabelValue, Name"):
        name, parts = row["name"], [row.get(f"color_{letter}", "") for letter in "rgb"]
        if name.startswith("'") and computed_by_spreadsheets(name[1:]):
            name = name[1:]
        red, green, blue = map(int, parts) if all(map(DIGITS.fullmatch, parts)) else (-1, -1, -1)
        found.append(NamedLabel(_label(row["labelvalue"], path), name, hex_colour(red, green, blue, top=255)))
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


def read_lines(text: str, path: Path, *, pattern: re.Pattern[str], form: str) -> list[NamedLabel]:
    """Rows by the groups label, name, red, green and blue (0 to 255) of the pattern; `#` begins a comment.

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


def _lines(text: str) -> list[tuple[int, str]]:
    lines = enumerate(text.splitlines(), start=1)
    return [(number, line) for number, line in lines if line.strip() and not line.lstrip().startswith("#")]


class _Pairs(list[tuple[str, Any]]):
    """The members of a JSON object in their order."""


def read_json_table(text: str, path: Path) -> list[NamedLabel]:
    """Rows of a JSON table; a key given twice is seen. Raises `InputDataError` for another document."""
    try:
        content = json.loads(text, object_pairs_hook=_Pairs)
    except (ValueError, RecursionError) as error:
        raise InputDataError(f"the label table '{path}' is not JSON: {error}; correct it there") from error
    pairs = content if isinstance(content, _Pairs) else None
    for key, value in pairs or ():
        if key == "labels" and isinstance(value, _Pairs):
            pairs = value
    if not pairs:
        raise InputDataError(f'the label table \'{path}\' names no label; write {{"1": "prostate"}}')
    rows = []
    for key, value in pairs:  # whichever side holds the number
        number, name = (value, key) if isinstance(value, int) and not isinstance(value, bool) else (key, value)
        plain = isinstance(number, int) or (isinstance(number, str) and DIGITS.fullmatch(number))
        label = int(number) if plain else -1
        if not 0 <= label <= MAX_LABEL or not isinstance(name, str) or not name.strip() or len(name) > MAX_NAME:
            kind = {_Pairs: "an object", list: "a list", int: "a number"}.get(type(value), "")
            shown = kind or repr(str(value)[:50])
            raise InputDataError(
                f"the label table '{path}' has the entry {key[:50]!r}: {shown}; it must be a label from 0"
                f" to {MAX_LABEL} and a name of 1 to {MAX_NAME} characters"
            )
        rows.append(NamedLabel(label, name))
    return rows


def _begins(text: str, pattern: re.Pattern[str]) -> bool:
    """Whether the first line that is neither blank nor a comment matches."""
    lines = _lines(text)
    return bool(lines) and pattern.fullmatch(lines[0][1]) is not None


CTBL_FORM = "the form `1 prostate 255 0 0 255` (no blank in a name)"
ITKSNAP_FORM = 'ITK-SNAP\'s form `1 255 0 0 1 1 1 "prostate"`'
TABLES = (
    TableFormat("a BIDS dseg.tsv", (".tsv",), lambda text: "\t" in text.partition("\n")[0], read_bids_table),
    TableFormat(
        "3D Slicer's CSV colour table", (".csv",), lambda text: "," in text.partition("\n")[0], read_slicer_table
    ),
    TableFormat(
        "3D Slicer's colour table",
        (".ctbl", ".txt"),
        partial(_begins, pattern=CTBL_ROW),
        partial(read_lines, pattern=CTBL_ROW, form=CTBL_FORM),
    ),
    TableFormat(
        "ITK-SNAP's label description",
        (".txt", ".label"),
        partial(_begins, pattern=QUOTED),
        partial(read_lines, pattern=ITKSNAP_ROW, form=ITKSNAP_FORM),
    ),
    TableFormat("JSON", (".json",), lambda _: True, read_json_table),
)
