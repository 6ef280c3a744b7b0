"""Label tables as JSON: {"1": "prostate"}, {"prostate": 1}, or either under "labels" (nnU-Net, TotalSegmentator)."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

from palpate.errors import InputDataError
from palpate.images.named_labels import MAX_LABEL, MAX_NAME, NamedLabel
from palpate.images.readers.table_registry import TableFormat, register_table

DIGITS = re.compile(r"[0-9]{1,9}")  # not what int() takes besides: blanks, signs, 1_0, digits of other scripts


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


register_table(TableFormat("JSON", (".json",), lambda _: True, read_json_table))
