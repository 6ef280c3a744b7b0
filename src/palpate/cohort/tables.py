"""cohort.csv and cohort.parquet: one line for each row, with its state, and value, interval, verdict of each tissue.

What is not identified has no number there: its verdict says so. `used_TISSUE` tells whether the row enters the
statistics of the tissue, `left_out_TISSUE` why it does not, `warnings` the codes of the warnings of its result.
"""

from __future__ import annotations

import csv
import io
from collections.abc import Sequence
from importlib import import_module
from pathlib import Path
from typing import Any

from palpate.cohort.records import Record, tissues_of
from palpate.cohort.selection import unit_of, why_left_out
from palpate.errors import ResourceError
from palpate.images.named_labels import computed_by_spreadsheets, printable
from palpate.study.outputs import write_text

CSV, PARQUET = "cohort.csv", "cohort.parquet"
COLUMNS = ("id", "patient", "session", "stage", "state", "failure_class", "message", "warnings")
UNITS = {"kPa": "kpa", "ratio": "ratio"}
ADVICE = "a cohort needs {}, which is not installed: pip install 'palpate[cohort]'"
LIBRARIES = ("pyarrow", "pandas", "statsmodels")


def columns_of(records: Sequence[Record]) -> dict[str, list[Any]]:
    """Name of a column -> its values, None where there is none; covariates stand last, as text."""
    columns: dict[str, list[Any]] = {
        "id": [record.row.id for record in records],
        "patient": [record.row.patient for record in records],
        "session": [record.row.session for record in records],
        "stage": [record.row.stage for record in records],
        "state": [record.state for record in records],
        "failure_class": [record.failure_class or None for record in records],
        "message": [record.message or None for record in records],
        "warnings": ["; ".join(record.warnings) or None for record in records],
    }
    for tissue in tissues_of(records):
        moduli = [record.modulus(tissue) for record in records]
        for unit, name in UNITS.items():
            if any(modulus is not None and modulus.unit == unit for modulus in moduli):
                columns[f"{tissue}_{name}"] = [
                    m.stated[0] if m is not None and m.unit == unit else None for m in moduli
                ]
        for place, end in enumerate(("low95", "high95"), start=1):
            columns[f"{tissue}_{end}"] = [None if modulus is None else modulus.stated[place] for modulus in moduli]
        columns[f"{tissue}_verdict"] = [None if modulus is None else modulus.verdict for modulus in moduli]
        unit = unit_of(records, tissue)
        reasons = [why_left_out(record, tissue, unit) for record in records]
        columns[f"used_{tissue}"] = [not reason for reason in reasons]
        columns[f"left_out_{tissue}"] = [reason or None for reason in reasons]
    for name in dict.fromkeys(name for record in records for name in record.row.covariates):
        columns.setdefault(name, [record.row.covariates.get(name) for record in records])
    return columns


def require_libraries(*more: str) -> None:
    """Raise `ResourceError` where a library of tables and statistics, or one `more`, is missing."""
    for library in (*LIBRARIES, *more):
        try:
            import_module(library)
        except ImportError as error:
            raise ResourceError(ADVICE.format(library)) from error


def write_csv(records: Sequence[Record], path: Path) -> None:
    """Write the table; a text that a spreadsheet would compute begins with an apostrophe. `ResourceError`."""
    columns = columns_of(records)
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow([_cell(name) for name in columns])
    writer.writerows([_cell(value) for value in line] for line in zip(*columns.values(), strict=True))
    write_text(path, text.getvalue())


def write_parquet(records: Sequence[Record], path: Path) -> None:
    """The same with types, texts as they are; raises `ResourceError` when the disk refuses or pyarrow is missing."""
    require_libraries()
    pyarrow, parquet = import_module("pyarrow"), import_module("pyarrow.parquet")
    numbers = ("_kpa", "_ratio", "_low95", "_high95")
    columns = columns_of(records)
    tissues = tuple(f"{tissue}{end}" for tissue in tissues_of(records) for end in numbers)
    types = {name: pyarrow.float64() if name in tissues else pyarrow.string() for name in columns}
    types["stage"] = pyarrow.int64()
    types |= {f"used_{tissue}": pyarrow.bool_() for tissue in tissues_of(records)}
    schema = pyarrow.schema(list(types.items()))
    try:
        parquet.write_table(pyarrow.table(columns, schema=schema), path)
    except OSError as error:
        raise ResourceError(f"cannot write {path.name}: {error}; free some space") from error


def _cell(value: Any) -> str:
    if isinstance(value, str):
        text = printable(value)
        return f"'{text}" if computed_by_spreadsheets(text) else text
    if isinstance(value, bool):
        return "true" if value else "false"
    return "" if value is None else repr(value)
