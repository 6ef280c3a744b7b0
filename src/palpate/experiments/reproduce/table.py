"""A table of the paper with our columns beside it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np

from palpate.experiments.reproduce.paper import PAPER_ITERATIONS

__all__ = ["COLUMNS", "Entry", "Table", "TableRow", "as_part", "entries_of"]

COLUMNS = ("same_mesh", "other_mesh", "voxels", "paper_method", "paper_method_other_mesh")
IDENTIFIED = "identified"


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
