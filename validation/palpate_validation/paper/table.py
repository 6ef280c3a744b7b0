"""A table of the paper with our columns beside it."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
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
    "Entry",
    "Table",
    "TableRow",
    "as_part",
    "draw_table",
    "entries_of",
    "save_figure",
]

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

STYLE = {
    "svg.fonttype": "none",
    "font.family": "sans-serif",
    "svg.hashsalt": "palpate",
    "font.size": 9.0,
    "axes.grid": True,
    "grid.alpha": 0.3,
}
COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9")  # Okabe & Ito 2008: safe for colour-blind
MARKERS = ("o", "s", "^", "D", "v")
SMALLEST = 1e-6  # per cent: what is smaller is drawn there


@dataclass(frozen=True, slots=True)
class Entry:
    """What one column says of one body; `kpa` is None when nothing converged, the interval where none is stated."""

    kpa: float | None
    error_percent: float | None
    interval95: tuple[float | None, float | None] | None
    verdict: str | None
    iterations: int

    @staticmethod
    def of(
        kpa: float | None,
        truth: float,
        *,
        interval95: tuple[float | None, float | None] | None = None,
        verdict: str | None = None,
        iterations: int,
    ) -> Entry:
        """The entry of a modulus (kPa) beside its `truth` (kPa); the error is 100 (kpa / truth - 1)."""
        error = None if kpa is None else 100.0 * (kpa / truth - 1.0)
        return Entry(kpa, error, interval95, verdict, iterations)

    @staticmethod
    def from_dict(stored: Mapping[str, Any]) -> Entry:
        """The entry that `asdict` has made a dictionary of, by way of JSON."""
        interval = stored["interval95"]
        return Entry(**{**stored, "interval95": None if interval is None else (interval[0], interval[1])})

    def scaled(self, factor: float) -> Entry:
        """The same problem in other units: moduli times `factor`, errors as they are."""
        ends = self.interval95
        scaled = None if ends is None else (ends[0] and factor * ends[0], ends[1] and factor * ends[1])
        return replace(self, kpa=None if self.kpa is None else factor * self.kpa, interval95=scaled)

    @property
    def counts(self) -> bool:
        """Whether its error is one of a stated result: not of a `weak` or `not identified` one."""
        return self.error_percent is not None and self.verdict in (None, IDENTIFIED)


def as_part(entries: Mapping[str, Entry]) -> dict[str, Any]:
    """Entries by body as a part of the ledger."""
    return {body: asdict(entry) for body, entry in entries.items()}


def entries_of(part: Mapping[str, Any]) -> dict[str, Entry]:
    """Entries by body of a part of the ledger."""
    return {body: Entry.from_dict(stored) for body, stored in part.items()}


@dataclass(frozen=True, slots=True)
class TableRow:
    """One body of one case: moduli in kPa, `paper_kpa` None where the paper has no such case."""

    case: str
    body: str
    true_kpa: float
    paper_kpa: float | None
    columns: Mapping[str, Entry]

    @property
    def start_kpa(self) -> float:
        """Half of the true modulus, as in the paper."""
        return 0.5 * self.true_kpa

    def to_dict(self) -> dict[str, Any]:
        """As JSON."""
        return {
            "body": self.body,
            "case": self.case,
            "true_kpa": self.true_kpa,
            "start_kpa": self.start_kpa,
            "paper_kpa": self.paper_kpa,
            "columns": {name: asdict(entry) for name, entry in self.columns.items()},
        }


@dataclass(frozen=True, slots=True)
class Table:
    """All rows of an experiment, and what has to be known to read them."""

    experiment: str
    rows: tuple[TableRow, ...]
    notes: tuple[str, ...]

    def to_dict(self) -> dict[str, Any]:
        """As JSON; `worst_error_percent` of the voxels is over the identified rows."""
        voxels = self._entries("voxels")
        errors = [abs(e.error_percent) for e in voxels if e.counts and e.error_percent is not None]
        return {
            "schema": "palpate.reproduce/1",
            "experiment": self.experiment,
            "rows": [row.to_dict() for row in self.rows],
            "worst_error_percent": {name: self._worst(name) for name in COLUMNS},
            "voxels": {
                "identified": len(errors),
                "rows": len(voxels),
                "rms_error_percent": float(np.sqrt(np.mean(np.square(errors)))) if errors else None,
                "truth_inside_interval": self._inside(),
            },
            "paper_iterations": PAPER_ITERATIONS,
            "notes": list(self.notes),
        }

    def text(self) -> list[list[str]]:
        """Rows of cells for a terminal: the heading, then one line a body."""
        heading = ["case", "body", "true kPa", "paper", *COLUMNS, "steps (paper's method)"]
        return [heading, *(self._cells(row) for row in self.rows), self._last_line()]

    def _cells(self, row: TableRow) -> list[str]:
        paper = "" if row.paper_kpa is None else _cell(row.paper_kpa, 100.0 * (row.paper_kpa / row.true_kpa - 1.0))
        ours = []
        for name in COLUMNS:
            entry = row.columns[name]
            aside = "" if entry.verdict in (None, IDENTIFIED) else f", {entry.verdict}"
            ours.append(_cell(entry.kpa, entry.error_percent) + aside)
        steps = str(row.columns["paper_method"].iterations)
        return [row.case, row.body, f"{row.true_kpa:g}", paper, *ours, steps]

    def _last_line(self) -> list[str]:
        papers = [abs(row.paper_kpa / row.true_kpa - 1.0) for row in self.rows if row.paper_kpa is not None]
        worst = [self._worst(name) for name in COLUMNS]
        cells = ["none" if value is None else f"{value:.2g} %" for value in worst]
        return ["worst", "", "", f"{100.0 * max(papers):.4g} %" if papers else "", *cells, ""]

    def _entries(self, column: str) -> Sequence[Entry]:
        return [row.columns[column] for row in self.rows]

    def _worst(self, column: str) -> float | None:
        entries = self._entries(column)
        errors = [abs(e.error_percent) for e in entries if e.counts and e.error_percent is not None]
        return max(errors, default=None)

    def _inside(self) -> int:
        """How many voxel rows have the truth inside their 95 % interval."""
        inside = 0
        for row in self.rows:
            interval = row.columns["voxels"].interval95
            if interval is not None:
                low, high = interval
                inside += (low is None or low <= row.true_kpa) and (high is None or row.true_kpa <= high)
        return inside


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
            places = np.arange(len(rows))
            papers = [
                (i, abs(100.0 * (r.paper_kpa / r.true_kpa - 1.0)))
                for i, r in enumerate(rows)
                if r.paper_kpa is not None
            ]
            if papers:
                axes.plot(*zip(*papers, strict=True), linestyle="none", marker="x", color="black", label="the paper")
            for name, colour, marker in zip(COLUMNS, COLOURS, MARKERS, strict=False):
                errors = [row.columns[name].error_percent for row in rows]
                sizes = [np.nan if error is None else max(abs(error), SMALLEST) for error in errors]
                axes.plot(places, sizes, linestyle="none", marker=marker, color=colour, markersize=4.5, label=name)
            axes.set_yscale("log")
            axes.minorticks_off()
            axes.set_xticks(places, [row.case for row in rows], rotation=60, ha="right", fontsize=7.5)
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
