"""Label tables: which number of a label image is which organ, and its colour.

JSON: {"1": "prostate"}, {"prostate": 1}, or either under "labels" (nnU-Net, TotalSegmentator) or "channel_def" (MONAI).
Named columns: *_dseg.tsv of BIDS derivatives, CSV colour tables of newer 3D Slicer. Lines of one form: colour tables of
3D Slicer and FreeSurfer, ITK-SNAP's descriptions.
"""

from __future__ import annotations

import csv
import io
import json
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from importlib import resources
from pathlib import Path
from typing import Any

from palpate.errors import InputDataError
from palpate.findings import Finding
from palpate.images.input_file import whole_input
from palpate.images.named_labels import ROW, LabelTable, NamedLabel, checked_table, hex_colour, printable
from palpate.images.named_labels import computed_by_spreadsheets as computed

# The classes of TotalSegmentator's tasks `total` (version 2, CT) and `total_mr`: facts, from its table `class_map`
# (https://github.com/wasserth/TotalSegmentator, totalsegmentator/map_to_binary.py). A class's number is its place in
# the list, from 1. No class of either task is the rectum.
TOTALSEGMENTATOR = resources.files("palpate.images") / "totalsegmentator.json"
CLASSES: Mapping[str, Mapping[str, int]] = {
    task: {name: number for number, name in enumerate(names, start=1)}
    for task, names in json.loads(TOTALSEGMENTATOR.read_text("utf-8")).items()
}
MAX_BYTES = 2**20
MAX_LINE = 1000  # letters of a line, because patterns are tried from each of them
ENDINGS = (".csv", ".ctbl", ".json", ".label", ".tsv", ".txt")
COLOUR = re.compile(r"#[0-9a-f]{6}")
COLUMNS = ("LabelValue", "Name", "Color_R", "Color_G", "Color_B", "Color_A")
AS_NUMBERS = "write the numbers as the label of a tissue in the case"
DIGITS = re.compile(r"[0-9]{1,9}")  # int() would also accept blanks, signs, 1_0 and digits of other scripts
COLOURS = r"(?P<red>[0-9]{1,3})\s+(?P<green>[0-9]{1,3})\s+(?P<blue>[0-9]{1,3})"
ITKSNAP_ROW = re.compile(r"(?P<label>[0-9]{1,9})\s+" + COLOURS + r'(?:\s+[0-9.eE+-]{1,20})*\s+"(?P<name>[^"]*)".*')
# 3D Slicer ignores what follows the opacity
SLICER_ROW = re.compile(
    r"(?P<label>[0-9]{1,9})\s+(?P<name>\S.*?)\s+" + COLOURS + r"(?:\s+[0-9.]{1,20}(?:\s+[^0-9\s].*)?)?"
)


def read_label_table(path: Path | str) -> LabelTable:
    """Read a label table: label (0 to 65535) -> name, sorted by label, with `colours` (#rrggbb) where it has them.

    JSON, ITK-SNAP's label description (.txt, .label), 3D Slicer's colour tables (.csv, .ctbl, .txt), BIDS dseg.tsv.
    Raises `InputDataError` for a file that cannot be read, or a label or name that is impossible or stands for two.
    """
    path = Path(path)
    ending, left = path.suffix.lower(), ""
    if ending not in ENDINGS:
        advice = f'the endings known are {", ".join(ENDINGS)}; write it as JSON, {{"1": "prostate"}}'
        raise InputDataError(f"no reader for the label table '{path}': {advice}")
    content, sha256 = whole_input(path, MAX_BYTES)
    try:
        text = content.decode("utf-8-sig")
        if ending == ".json":
            rows, left = _json_rows(text)
        else:
            rows = (_column_rows if ending in (".csv", ".tsv") else _line_rows)(text)
    except (UnicodeDecodeError, csv.Error) as error:
        raise InputDataError(f"the label table '{path}' is not UTF-8 text, or damaged ({error}); export it") from error
    except ValueError as error:
        raise InputDataError(f"the label table '{path}' {error}; correct it") from error
    left = f"the label table '{path}' has regions, which were left out: {left}; {AS_NUMBERS}" if left else ""
    table = checked_table(rows, path)
    if not table:
        raise InputDataError(f"the label table '{path}' names no label; {left or 'is it another file?'}")
    return replace(table, sha256=sha256, findings=(Finding("names-left-out", left),) if left else ())


def _column_rows(text: str) -> list[NamedLabel]:
    """Rows by the columns of their first line: label and name, and the colour where one is possible."""
    heading = text.partition("\n")[0]
    names, *lines = [*csv.reader(io.StringIO(text), delimiter=max("\t,;", key=heading.count))] or [[]]
    columns = [name.strip().lower() for name in names]
    key = "labelvalue" if "labelvalue" in columns else "index"
    if key not in columns or "name" not in columns:
        flaw = "lacks the columns LabelValue and Name (3D Slicer) or index and name (BIDS)"
        raise ValueError(f"{flaw}; its first line is {heading[:60]!r}")
    found = []
    for line in lines:
        row = dict.fromkeys(columns, "") | dict(zip(columns, map(str.strip, line), strict=False))
        if not any(row.values()):
            continue
        name, colour, parts = row["name"], row.get("color", "").lower(), [row.get(f"color_{c}", "") for c in "rgb"]
        if not DIGITS.fullmatch(row[key]):
            raise ValueError(f"has the label {row[key][:50]!r}, which is no whole number")
        if name.startswith("'") and computed(name[1:]):
            name = name[1:]
        if all(map(DIGITS.fullmatch, parts)):
            colour = hex_colour([int(part) for part in parts], top=255) or ""
        found.append(NamedLabel(int(row[key]), name, colour if COLOUR.fullmatch(colour) else None))
    return found


def slicer_table(rows: Iterable[NamedLabel]) -> str:
    """The text of such a table: LabelValue, Name and, where a row has one, its colour.

    A name that a spreadsheet would take for a formula gets an apostrophe in front, which reading takes away.
    """
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(COLUMNS)
    for row in rows:
        name = f"'{row.name}" if computed(row.name) else row.name
        parts = [] if row.colour is None else [*bytes.fromhex(row.colour[1:]), 255]
        writer.writerow([row.label, name, *(parts or [""] * 4)])
    return text.getvalue()


def _line_rows(text: str) -> list[NamedLabel]:
    """Rows of ITK-SNAP, whose names stand in quotation marks, or of 3D Slicer and FreeSurfer; `#` begins a comment."""
    lines = [(number, line.strip()) for number, line in enumerate(text.splitlines(), start=1)]
    lines = [(number, line) for number, line in lines if line and not line.startswith("#")]
    form, pattern = "the form `1 prostate 255 0 0 255`", SLICER_ROW
    if lines and '"' in lines[0][1]:
        form, pattern = 'ITK-SNAP\'s form `1 255 0 0 1 1 1 "prostate"`', ITKSNAP_ROW
    rows = []
    for number, line in lines:
        found = pattern.fullmatch(line) if len(line) <= MAX_LINE else None
        if found is None:
            raise ValueError(f"has line {number} {line[:60]!r}, not of {form}")
        colour = hex_colour([int(found[part]) for part in ("red", "green", "blue")], top=255)
        rows.append(NamedLabel(int(found["label"]), found["name"], colour))
    return rows


class _Pairs(list[tuple[str, Any]]):
    """The members of a JSON object in their order."""


def _labels_in(content: Any) -> _Pairs | None:
    """The first object under `labels` or `channel_def`, however deep; None without one."""
    for key, value in content if isinstance(content, _Pairs) else ():
        own = key in ("labels", "channel_def") and isinstance(value, _Pairs)
        if (found := value if own else _labels_in(value)) is not None:
            return found
    return None


def _json_rows(text: str) -> tuple[list[NamedLabel], str]:
    """Rows of a JSON table, where a key given twice is seen, and the regions that are left out, in words."""
    try:
        content = json.loads(text, object_pairs_hook=_Pairs)
        pairs = _labels_in(content) or content
    except (ValueError, RecursionError) as error:
        raise ValueError(f"is not JSON: {error}") from error
    if not isinstance(pairs, _Pairs) or not pairs:
        raise ValueError('names no label; write {"1": "prostate"}')
    numbers, rows = dict[str, list[int]](), []
    for key, given in pairs:  # the number may stand on either side
        several = given if isinstance(given, list) and {type(each) for each in given} == {int} else []
        if len(set(several)) > 1:
            numbers[key] = several
            continue
        value = several[0] if several else given
        number, name = (value, key) if type(value) is int else (key, value)
        if not DIGITS.fullmatch(str(number)) or not isinstance(name, str):
            raise ValueError(f"has the entry {key[:50]!r}, which is not {ROW}")
        rows.append(NamedLabel(int(number), name))
        numbers[name] = [int(number)]
    order = next((value for key, value in content if key == "regions_class_order"), None)
    left = _regions(numbers, order if isinstance(order, list) else [])
    return [row for row in rows if row.name not in left], ", ".join(left.values())


def _regions(numbers: Mapping[str, Sequence[int]], order: Sequence[Any]) -> dict[str, str]:
    """Names of several numbers, or of another number in predictions, each with its numbers in words.

    numbers: by name in the order of the file; order: what nnU-Net writes for them (regions_class_order), where a voxel
    keeps the number of the last region that it is in.
    """
    kept = [name for name, each in numbers.items() if set(each) != {0} and name != "ignore"]
    found = {}
    for name in kept if any(len(set(each)) > 1 for each in numbers.values()) else ():
        inner = [place for place, other in enumerate(kept) if set(numbers[other]) <= set(numbers[name])]
        predicted = [order[place] for place in inner] if len(order) == len(kept) else numbers[name]
        if len(set(numbers[name])) > 1 or list(predicted) != list(numbers[name]):
            words = f", in a prediction {predicted}" * (set(predicted) != set(numbers[name]))
            found[name] = f"'{printable(name)}' ({list(numbers[name])}{words})"
    return found
