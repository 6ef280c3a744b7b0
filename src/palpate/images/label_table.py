"""Label tables: which number of a label image is which organ."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

from palpate.errors import InputDataError

__all__ = ["read_label_table"]

MAX_BYTES = 2**20
MAX_LABEL = 65535
MAX_NAME = 200


def read_label_table(path: Path | str) -> dict[int, str]:
    """Read a label table: label (0 to 65535) -> name, sorted by label.

    JSON files may be `{"labels": {"1": "prostate"}}`, `{"1": "prostate"}` or `{"prostate": 1}`.
    Raises `InputDataError` for a file that cannot be read, or a label or name that is impossible or given twice.
    """
    path = Path(path)
    reader = _READERS.get(path.suffix.lower())
    if reader is None:
        raise InputDataError(
            f"no reader for the label table '{path}': the endings known are {', '.join(sorted(_READERS))}; write it as"
            ' JSON, {"1": "prostate"}'
        )
    table: dict[int, str] = {}
    for label, name in reader(_text(path), path):
        if label in table or name in table.values():
            raise InputDataError(f"the label table '{path}' names {label} or '{name}' twice; keep one line of the two")
        table[label] = name
    return dict(sorted(table.items()))


def _text(path: Path) -> str:
    try:
        with path.open("rb") as file:
            content = file.read(MAX_BYTES + 1)
    except (OSError, ValueError) as error:
        raise InputDataError(f"the label table '{path}' cannot be read ({error}); check the path") from error
    if len(content) > MAX_BYTES:
        raise InputDataError(f"the label table '{path}' is larger than {MAX_BYTES} bytes; is it another file?")
    try:
        return content.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise InputDataError(f"the label table '{path}' is not UTF-8 text ({error}); save it as UTF-8") from error


def _read_json(text: str, path: Path) -> list[tuple[int, str]]:
    # Pairs instead of a dict: a key given twice must be seen.
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
    return [_entry(key, value, path) for key, value in pairs]


class _Pairs(list[tuple[str, Any]]):
    """The members of a JSON object in their order."""


def _entry(key: str, value: Any, path: Path) -> tuple[int, str]:
    """One member, whichever side holds the number."""
    number, name = (value, key) if isinstance(value, int) and not isinstance(value, bool) else (key, value)
    try:
        label = int(str(number))
    except ValueError:
        label = -1
    if not 0 <= label <= MAX_LABEL or not isinstance(name, str) or not name.strip() or len(name) > MAX_NAME:
        raise InputDataError(
            f"the label table '{path}' has the entry {str(key)[:50]!r}: {str(value)[:50]!r}; it must be a label from 0"
            f" to {MAX_LABEL} and a name of 1 to {MAX_NAME} characters"
        )
    if not name.isprintable():
        raise InputDataError(f"the label table '{path}' has control characters in the name {name!r}; remove them")
    return label, name.strip()


_READERS: dict[str, Callable[[str, Path], list[tuple[int, str]]]] = {".json": _read_json}
