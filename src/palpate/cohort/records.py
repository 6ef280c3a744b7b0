"""What a cohort knows of each row: its state, and the numbers of its result."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from palpate.cohort.mark import document_of
from palpate.cohort.plan import CASES, Plan
from palpate.cohort.task import Outcome, Row
from palpate.parallel import mapped

__all__ = ["Modulus", "Record", "records_of", "tissues_of"]


@dataclass(frozen=True, slots=True)
class Modulus:
    """A tissue's modulus in one row: `unit` "kPa" or "ratio", 95 % interval with None for an open end, verdict."""

    tissue: str
    unit: str
    value: float | None
    low95: float | None
    high95: float | None
    verdict: str


@dataclass(frozen=True, slots=True)
class Record:
    """A row with what it came to: `state` "done", "failed" or "waiting"."""

    row: Row
    state: str
    failure_class: str = ""
    message: str = ""
    moduli: tuple[Modulus, ...] = ()
    seconds: float = 0.0
    peak_gb: float | None = None
    page: str = ""  # of its report, from the cohort's folder

    def modulus(self, tissue: str) -> Modulus | None:
        """That of a tissue, None where it was not asked for or not found."""
        return next((modulus for modulus in self.moduli if modulus.tissue == tissue), None)


def records_of(plan: Plan, folder: Path) -> tuple[Record, ...]:
    """A record for each row of the plan, in its order, from the files of the cohort's folder."""
    marks = plan.marks(folder)
    return tuple(mapped(partial(_record, plan, folder, marks), range(len(marks))))


def tissues_of(records: Sequence[Record]) -> tuple[str, ...]:
    """The tissues that any record has a modulus of, in the order of their first appearance."""
    return tuple(dict.fromkeys(modulus.tissue for record in records for modulus in record.moduli))


def _record(plan: Plan, folder: Path, marks: Sequence[Outcome | None], number: int) -> Record:
    row, mark = plan.rows[number], marks[number]
    place = folder / CASES / row.id
    if mark is None:
        return Record(row, "waiting")
    page = f"{CASES}/{row.id}/report.html" if mark.result and (place / "report.html").is_file() else ""
    took = (mark.seconds, mark.peak_gb, page)
    if mark.state != "done":
        return Record(row, "failed", mark.failure_class, mark.message, (), *took)
    document = document_of(place, mark)
    if document is None:
        return Record(row, "waiting")
    moduli = []
    for item in document["estimates"]:
        if item["parameter"] != "youngs_modulus":
            continue
        in_kpa = item["value"] is not None
        low, high = (item["interval95"] if in_kpa else item["ratio_interval95"]) or (None, None)
        value = item["value"] if in_kpa else item["ratio"]
        moduli.append(Modulus(item["tissue"], "kPa" if in_kpa else "ratio", value, low, high, item["verdict"]))
    return Record(row, "done", "", mark.message, tuple(moduli), *took)
