"""What a cohort knows of each row: its state, and the numbers of its result."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from palpate.cohort.plan import CASES, Plan
from palpate.cohort.task import Row
from palpate.errors import InputDataError
from palpate.parallel import mapped
from palpate.study.outputs import RESULT, read_json
from palpate.uncertainty import NORMAL_95
from palpate.unknowns import KNOWN_MODULUS

NEARLY = 0.95  # of that: a profile that comes so far has reached the end
NOT_IMAGES = ("names", "mesh")  # inputs that two patients may well share

End = float | None


@dataclass(frozen=True, slots=True)
class Modulus:
    """A tissue's modulus in one row: `unit` "kPa" or "ratio", 95 % interval with None for an open end, verdict.

    Of one that is not identified the ends only censor it; what may be shown of a modulus is `stated`.
    """

    tissue: str
    unit: str
    value: End
    low95: End
    high95: End
    verdict: str

    @property
    def stated(self) -> tuple[End, End, End]:
        """Value and both ends, all None where the modulus is not identified."""
        return (None, None, None) if self.verdict == "not identified" else (self.value, self.low95, self.high95)


@dataclass(frozen=True, slots=True)
class Record:
    """A row with what it came to: `state` "done", "failed" or "waiting".

    warnings: codes that its result carries, each once; images: key of an input ("before", "after[0]") -> SHA-256.
    """

    row: Row
    state: str
    failure_class: str = ""
    message: str = ""
    moduli: tuple[Modulus, ...] = ()
    seconds: float = 0.0
    peak_gb: float | None = None
    page: str = ""  # of its report, from the cohort's folder
    warnings: tuple[str, ...] = ()
    images: Mapping[str, str] = field(default_factory=dict)

    def modulus(self, tissue: str) -> Modulus | None:
        """That of a tissue, None where it was not asked for or not found."""
        return next((modulus for modulus in self.moduli if modulus.tissue == tissue), None)


def records_of(plan: Plan, folder: Path) -> tuple[Record, ...]:
    """A record for each row of the plan, in its order, from the files of the cohort's folder."""
    marks = plan.marks(folder)

    def record(number: int) -> Record:
        """That of one row."""
        row, mark = plan.rows[number], marks[number]
        place = folder / CASES / row.id
        if mark is None:
            return Record(row, "waiting")
        page = f"{CASES}/{row.id}/report.html" if mark.result and (place / "report.html").is_file() else ""
        took = (mark.seconds, mark.peak_gb, page)
        if mark.state != "done":
            return Record(row, "failed", mark.failure_class, mark.message, (), *took)
        try:
            document = read_json(place / RESULT)
        except InputDataError:  # the file that the mark vouches for is gone
            return Record(row, "waiting")
        moduli = tuple(modulus_of(item) for item in document["estimates"] if item["parameter"] == "youngs_modulus")
        codes = tuple(dict.fromkeys(warning["code"] for warning in document.get("warnings", ())))
        inputs = document.get("inputs", {})
        keys = [key for key in inputs if key not in NOT_IMAGES and f"{key}.voxels" not in inputs]
        images = {key: inputs[key]["sha256"] for key in keys}
        return Record(row, "done", "", mark.message, moduli, *took, codes, images)

    return tuple(mapped(record, range(len(marks))))


def tissues_of(records: Sequence[Record]) -> tuple[str, ...]:
    """The tissues that any record has a modulus of, in the order of their first appearance."""
    return tuple(dict.fromkeys(modulus.tissue for record in records for modulus in record.moduli))


def modulus_of(item: Mapping[str, Any]) -> Modulus:
    """That of an entry of `estimates`: the ratio where its scale is a range, which all scans would err by together.

    Where no interval is stated, its ends are those of the profile [value, signed root deviance], where that meets -1.96
    and 1.96 by a line; None where it ends before.
    """
    stated = item.get("unit") or ("ratio" if item["value"] is None else "kPa")
    ranged = KNOWN_MODULUS in (item.get("variance_shares") or {})
    unit = "ratio" if ranged else stated
    value, ends = (item["ratio"], item["ratio_interval95"]) if unit == "ratio" else (item["value"], item["interval95"])
    reference = item["value"] / item["ratio"] if ranged and item["value"] and item["ratio"] else 1.0
    if not ends:
        profile = [(at / reference, root) for at, root in item.get("profile") or ()]
        centre, ends = min(profile, key=lambda point: abs(point[1]), default=(1.0, 0.0))[0], list[End]()
        for sign in (-1.0, 1.0):
            reached = [(at, sign * root) for at, root in profile if sign * root >= NEARLY * NORMAL_95]
            at, root = min(reached, key=lambda point: abs(point[1] - NORMAL_95), default=(centre, 0.0))
            ends.append(centre * math.exp(math.log(at / centre) * NORMAL_95 / root) if reached else None)
    low, high = ends
    return Modulus(item["tissue"], unit, value, low, high, item["verdict"])
