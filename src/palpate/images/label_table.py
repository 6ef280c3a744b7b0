"""Label tables: which number of a label image is which organ, and its colour."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from palpate.errors import InputDataError
from palpate.images.input_file import read_input
from palpate.images.named_labels import LabelTable, checked_table
from palpate.images.readers.table_registry import read_rows, table_formats

MAX_BYTES = 2**20


def read_label_table(path: Path | str) -> LabelTable:
    """Read a label table: label (0 to 65535) -> name, sorted by label, with `colours` (#rrggbb) where it has them.

    JSON, ITK-SNAP's label description (.txt, .label), 3D Slicer's colour tables (.csv, .ctbl, .txt), BIDS dseg.tsv.
    Raises `InputDataError` for a file that cannot be read, or a label or name that is impossible or given twice.
    """
    path = Path(path)
    candidates = table_formats(path)
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
    table = checked_table(read_rows(text, path, candidates), path)
    if not table:
        raise InputDataError(f"the label table '{path}' names no label; is it another file?")
    return replace(table, sha256=sha256)
