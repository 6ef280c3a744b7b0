"""Label descriptions of ITK-SNAP: lines of `IDX R G B A VIS MSH "LABEL"`, colours from 0 to 255."""

from __future__ import annotations

import re
from functools import partial
from pathlib import Path

from palpate.images.named_labels import NamedLabel
from palpate.images.readers.pattern_rows import COLOURS, begins_with, pattern_rows
from palpate.images.readers.table_registry import TableFormat, register_table

__all__ = ["read_itksnap_table"]

ROW = re.compile(
    r"\s*(?P<label>[0-9]{1,9})\s+" + COLOURS + r'\s+[0-9.eE+-]{1,20}\s+[0-9]\s+[0-9]\s+"(?P<name>[^"]*)"\s*'
)
QUOTED = re.compile(r'.*".*')


def read_itksnap_table(text: str, path: Path) -> list[NamedLabel]:
    """Rows of a label description; `#` begins a comment. Raises `InputDataError` for a line of another form."""
    return pattern_rows(text, path, ROW, form='ITK-SNAP\'s form `1 255 0 0 1 1 1 "prostate"`')


register_table(
    TableFormat(
        "ITK-SNAP's label description", (".txt", ".label"), partial(begins_with, pattern=QUOTED), read_itksnap_table
    )
)
