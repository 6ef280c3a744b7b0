"""What a command has to say at its end, to programs and to people."""

from __future__ import annotations

import textwrap
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import zip_longest
from typing import TYPE_CHECKING, Any

from palpate.cli.console import log_is_open
from palpate.images.named_labels import printable

if TYPE_CHECKING:
    from palpate.study.outputs import OutputFolder


GAP = "  "  # between columns
PAGES = ("report.html", "sensitivity.html")  # of which the first that was written is to be looked at
MOST_LETTERS, LEAST_LETTERS = 100, 20  # of a line in a terminal; of a column that is broken


@dataclass(frozen=True, slots=True)
class Outcome:
    """A JSON document, the same as text for people, the exit code, and a complaint for stderr."""

    document: Mapping[str, Any]
    text: str
    exit_code: int = 0
    complaint: str = ""


def estimates_table(document: Mapping[str, Any]) -> str:
    """The estimates of a result as aligned columns, what its maps say, and its note."""
    from palpate.report.rows import NONE, expected_share, interval_text, moduli_in, number, ratio_rows
    from palpate.report.units import shown_unit

    shown = shown_unit(document)
    rows = [["tissue", "Young's modulus", "95 % interval", "ratio", "verdict", "truth"]]
    missed = any(warning["code"] == "data-misfit" for warning in document["warnings"])
    for item in moduli_in(document):
        interval, ratio = item["interval95"], number(item["ratio"])
        value, unit = number(item["value"]) + (" kPa" if item["value"] is not None else ""), " kPa"
        if item["verdict"] == "ratio only" and item["ratio"] is not None:  # the scale in kPa is not known well enough
            value, interval, unit = f"{ratio} x {item['relative_to']}", item["ratio_interval95"], " (ratio)"
        if interval is None and item["ratio_interval95"] is not None:
            interval, unit = item["ratio_interval95"], " (ratio)"
        rows.append(
            [
                item["tissue"],
                value,
                interval_text(interval) + (unit if interval else ""),
                f"{ratio} to {item['relative_to']}" if item["ratio"] is not None else "–",
                item["verdict"] + (", but data are missed" if missed and item["verdict"] != "not identified" else ""),
                number(shown.truth(item)),
            ]
        )
    if all(row[-1] == "–" for row in rows[1:]):
        rows = [row[:-1] for row in rows]
    ratios = [[row.tissue, row.value, row.interval, row.verdict] for row in ratio_rows(document)]
    more = [columns([["tissue", "Poisson's ratio", "95 % interval", "verdict"], *ratios])] if ratios else []
    far = []
    for item in moduli_in(document):
        (found, ends), truth = shown.numbers(item), shown.truth(item)
        if found and truth and (share := expected_share(found, ends, truth)) != NONE:
            error = f"{100.0 * (found / truth - 1.0):+.0f} %"
            far.append(f"{item['tissue']} {error} ({share} of estimates with this interval are off by as much or more)")
    more += [f"error against the truth: {', '.join(far)}"] if far else []
    maps = [item["words"] for item in document.get("maps", ())]
    note = [document["note"]] if document.get("note") else []
    return "\n".join([columns(rows), *more, *maps, *note])


def listed(outputs: OutputFolder) -> str:
    """Where the files are that the run has written, and which; those of a sub-folder by its name; which one to open."""
    names = dict.fromkeys(name.split("/")[0] + ("/" if "/" in name else "") for name in outputs.written)
    log = ["log.txt"] if log_is_open() else []
    page = next((f"\nopen {outputs.path / name}" for name in PAGES if name in outputs.written), "")
    return f"written to {outputs.path}: {', '.join([*names, *log])}{page}"


def columns(rows: Sequence[Sequence[str]]) -> str:
    """Rows of cells as lines of aligned columns; of a table that is wider than a terminal the widest one is broken."""
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    beyond = sum(widths) + len(GAP) * (len(widths) - 1) - MOST_LETTERS
    widest = widths.index(max(widths))
    if beyond > 0:
        widths[widest] = max(widths[widest] - beyond, LEAST_LETTERS)
    lines = list[str]()
    for row in rows:
        broken = [textwrap.wrap(cell, width, break_on_hyphens=False) for cell, width in zip(row, widths, strict=True)]
        cells = zip_longest(*(parts or [""] for parts in broken), fillvalue="")
        lines += [GAP.join(map(str.ljust, parts, widths)).rstrip() for parts in cells]
    return "\n".join(lines)


def printable_lines(text: str) -> str:
    """`text`, each of its lines made `printable`: names in files could command a terminal."""
    return "\n".join(printable(line) for line in text.split("\n"))
