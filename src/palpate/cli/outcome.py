"""What a command has to say at its end, to programs and to people."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

__all__ = ["Outcome", "columns", "estimates_table", "printable", "warning_lines"]


@dataclass(frozen=True, slots=True)
class Outcome:
    """A JSON document, the same as text for people, the exit code, and a complaint for stderr."""

    document: Mapping[str, Any]
    text: str
    exit_code: int = 0
    complaint: str = ""


def estimates_table(document: Mapping[str, Any]) -> str:
    """The estimates of a result as aligned columns, with its note."""
    from palpate.report.rows import number

    rows = [["tissue", "Young's modulus", "95 % interval", "ratio", "verdict", "truth"]]
    for item in document["estimates"]:
        interval, ratio = item["interval95"], number(item["ratio"])
        rows.append(
            [
                item["tissue"],
                number(item["value"]) + (" kPa" if item["value"] is not None else ""),
                f"{number(interval[0])} to {number(interval[1])} kPa" if interval else "–",
                f"{ratio} to {item['relative_to']}" if item["ratio"] is not None else "–",
                item["verdict"],
                number(item["truth"]),
            ]
        )
    if all(row[-1] == "–" for row in rows[1:]):
        rows = [row[:-1] for row in rows]
    note = [document["note"]] if document.get("note") else []
    return "\n".join([columns(rows), *note])


def columns(rows: Sequence[Sequence[str]]) -> str:
    """Rows of cells as lines of aligned columns."""
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    lines = ["  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip() for row in rows]
    return "\n".join(lines)


def warning_lines(document: Mapping[str, Any]) -> str:
    """The document's warnings, a line each."""
    return "".join(f"warning: {warning['message']}\n" for warning in document["warnings"])


def printable(text: str) -> str:
    """`text` without control characters, which names in files could use to command a terminal."""
    return "".join(letter if letter.isprintable() or letter == "\n" else "?" for letter in text)
