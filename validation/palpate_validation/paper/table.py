"""A table of the paper with our columns beside it."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.figure import Figure

__all__ = [
    "COLOURS",
    "COLUMNS",
    "PAPER_STAGING",
    "PAPER_TABLE1",
    "PAPER_TABLE2",
    "Entries",
    "Entry",
    "Table",
    "TableRow",
    "draw_table",
    "entry_of",
    "save_figure",
]

Entry = dict[str, Any]
"""What one column says of one body, of JSON: kpa (None when nothing converged), error_percent, interval95 (None where
none is stated), verdict, iterations."""
Entries = dict[str, Entry]  # by body: a part of the ledger

# the paper's own numbers: Yang & Lin, tables 1 and 2, section 4.3 (correlations) and section 4.4 (iterations)
PAPER_ITERATIONS = "less than 10"

# true modulus, kPa: recovered moduli, kPa
PAPER_TABLE1: dict[float, dict[str, float]] = {
    50.0: {"sphere1": 49.23, "sphere2": 49.54, "sphere3": 49.55},
    70.0: {"sphere1": 66.14, "sphere2": 67.41, "sphere3": 67.15},
    90.0: {"sphere1": 89.18, "sphere2": 89.52, "sphere3": 89.68},
    110.0: {"sphere1": 107.93, "sphere2": 108.76, "sphere3": 109.17},
    130.0: {"sphere1": 112.89, "sphere2": 118.95, "sphere3": 124.89},
    150.0: {"sphere1": 132.87, "sphere2": 138.78, "sphere3": 145.32},
}
PAPER_TABLE2: dict[float, dict[str, float]] = {
    50.0: {"prostate": 53.28, "bladder": 49.67},
    100.0: {"prostate": 107.50, "bladder": 97.78},
    150.0: {"prostate": 157.53, "bladder": 146.49},
    200.0: {"prostate": 209.08, "bladder": 198.07},
    250.0: {"prostate": 263.30, "bladder": 248.60},
    300.0: {"prostate": 315.14, "bladder": 296.86},
}
# Pearson's r with the T stage, and its two-tailed p
PAPER_STAGING: dict[str, tuple[float, float]] = {"prostate": (0.658, 3.16e-5), "bladder": (0.481, 4.60e-3)}

COLUMNS = ("same_mesh", "other_mesh", "voxels", "paper_method", "paper_method_other_mesh")
IDENTIFIED = "identified"

STYLE = {"svg.fonttype": "none", "svg.hashsalt": "palpate", "font.size": 9.0, "axes.grid": True, "grid.alpha": 0.3}
COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9")  # Okabe & Ito 2008: safe for colour-blind
SMALLEST = 1e-6  # per cent: what is smaller is drawn there


def entry_of(
    kpa: float | None,
    truth: float,
    *,
    interval95: Sequence[float | None] | None = None,
    verdict: str | None = None,
    iterations: int,
) -> Entry:
    """The entry of a modulus (kPa) beside its `truth` (kPa); the error is 100 (kpa / truth - 1)."""
    error = None if kpa is None else 100.0 * (kpa / truth - 1.0)
    ends = None if interval95 is None else list(interval95)
    return {"kpa": kpa, "error_percent": error, "interval95": ends, "verdict": verdict, "iterations": iterations}


@dataclass(frozen=True, slots=True)
class TableRow:
    """One body of one case: moduli in kPa, `paper_kpa` None where the paper has no such case."""

    case: str
    body: str
    true_kpa: float
    paper_kpa: float | None
    columns: Mapping[str, Entry]

    def to_dict(self) -> dict[str, Any]:
        """As JSON; the start is half of the true modulus, as in the paper."""
        return {
            "body": self.body,
            "case": self.case,
            "true_kpa": self.true_kpa,
            "start_kpa": 0.5 * self.true_kpa,
            "paper_kpa": self.paper_kpa,
            "columns": dict(self.columns),
        }

    def stated(self, column: str) -> float | None:
        """The absolute error (%) of a column's stated result: not of a `weak` or `not identified` one."""
        entry = self.columns[column]
        counts = entry["error_percent"] is not None and entry["verdict"] in (None, IDENTIFIED)
        return abs(entry["error_percent"]) if counts else None


@dataclass(frozen=True, slots=True)
class Table:
    """All rows of an experiment, and what has to be known to read them."""

    experiment: str
    rows: tuple[TableRow, ...]
    notes: tuple[str, ...]

    def to_dict(self) -> dict[str, Any]:
        """As JSON; `worst_error_percent` of the voxels is over the identified rows."""
        errors = self._stated("voxels")
        ends = [(row.columns["voxels"]["interval95"], row.true_kpa) for row in self.rows]
        inside = [
            (end[0] is None or end[0] <= truth) and (end[1] is None or truth <= end[1]) for end, truth in ends if end
        ]
        return {
            "schema": "palpate.reproduce/1",
            "experiment": self.experiment,
            "rows": [row.to_dict() for row in self.rows],
            "worst_error_percent": {name: max(self._stated(name), default=None) for name in COLUMNS},
            "voxels": {
                "identified": len(errors),
                "rows": len(self.rows),
                "rms_error_percent": float(np.sqrt(np.mean(np.square(errors)))) if errors else None,
                "truth_inside_interval": sum(inside),
            },
            "paper_iterations": PAPER_ITERATIONS,
            "notes": list(self.notes),
        }

    def _stated(self, column: str) -> list[float]:
        return [error for row in self.rows if (error := row.stated(column)) is not None]

    def text(self) -> list[list[str]]:
        """Rows of cells for a terminal: the heading, one line a body, the worst errors."""
        found = [["case", "body", "true kPa", "paper", *COLUMNS, "steps (paper's method)"]]
        papers = [100.0 * (row.paper_kpa / row.true_kpa - 1.0) if row.paper_kpa else None for row in self.rows]
        for row, paper in zip(self.rows, papers, strict=True):
            cells = [row.case, row.body, f"{row.true_kpa:g}", "" if paper is None else _cell(row.paper_kpa, paper)]
            for entry in (row.columns[name] for name in COLUMNS):
                aside = "" if entry["verdict"] in (None, IDENTIFIED) else f", {entry['verdict']}"
                cells.append(_cell(entry["kpa"], entry["error_percent"]) + aside)
            found.append([*cells, str(row.columns["paper_method"]["iterations"])])
        worst = [self._stated(name) for name in COLUMNS]
        cells = [f"{max(errors):.2g} %" if errors else "none" for errors in worst]
        theirs = [abs(paper) for paper in papers if paper is not None]
        return [*found, ["worst", "", "", f"{max(theirs):.4g} %" if theirs else "", *cells, ""]]


def _cell(kpa: float | None, error: float | None) -> str:
    return "none" if kpa is None or error is None else f"{kpa:.2f} ({error:+.2g} %)"


def draw_table(table: Table, path: Path) -> None:
    """Absolute errors of every column and of the paper, a panel a body, into `path` (SVG)."""
    bodies = list(dict.fromkeys(row.body for row in table.rows))

    def draw(figure: Figure) -> None:
        """All panels."""
        panels = figure.subplots(1, len(bodies), sharey=True, squeeze=False)[0]
        for axes, body in zip(panels, bodies, strict=True):
            rows = [row for row in table.rows if row.body == body]
            lines: dict[str, list[float | None]] = {
                name: [row.columns[name]["error_percent"] for row in rows] for name in COLUMNS
            }
            lines["the paper"] = [100.0 * (r.paper_kpa / r.true_kpa - 1.0) if r.paper_kpa else None for r in rows]
            for (name, errors), colour, marker in zip(lines.items(), (*COLOURS[:5], "black"), "os^Dvx", strict=True):
                sizes = [np.nan if error is None else max(abs(error), SMALLEST) for error in errors]
                axes.plot(sizes, linestyle="none", marker=marker, color=colour, markersize=4.5, label=name)
            axes.set_yscale("log")
            axes.set_xticks(range(len(rows)), [row.case for row in rows], rotation=60, ha="right", fontsize=7.5)
            axes.set_xlabel("true modulus, kPa")
            axes.set_title(body)
        panels[0].set_ylabel("absolute error of the modulus, %")
        figure.legend(*panels[0].get_legend_handles_labels(), loc="outside lower center", ncols=3, frameon=False)

    save_figure(draw, path, width=3.2 * len(bodies) + 0.8)


def save_figure(draw: Callable[[Figure], None], path: Path, *, width: float) -> None:
    """Draw a figure of `width` inches into `path` (SVG)."""
    with mpl.rc_context(STYLE):
        figure = Figure(figsize=(width, 4.0), layout="constrained")
        draw(figure)
        figure.savefig(path, format="svg", metadata={"Date": None})
