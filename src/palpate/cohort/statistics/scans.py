"""The scans of a cohort that its statistics are made of: which count, and by which rule the others do not."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from palpate.cohort.records import Record

__all__ = ["RULE", "Scan", "Usable", "inside_fences", "usable_scans"]

RULE = (
    "A scan counts when its row is done and its modulus is identified or weak; one that is not identified has no upper"
    " or lower end, and is left out and counted as such."
)
HALF_WIDTH = 1.959963984540054  # of a 95 % interval, in standard deviations
LEAST_SD = 1e-3  # of ln E: nothing is known better
FENCE = 1.5  # Tukey's, which box plots draw their outliers by (Exploratory Data Analysis, 1977)

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Scan:
    """One row's modulus of one tissue, `sd` the standard deviation of its logarithm from the 95 % interval."""

    id: str
    patient: str
    session: str
    stage: int | None
    value: float
    low95: float
    high95: float
    sd: float
    verdict: str


@dataclass(frozen=True, slots=True)
class Usable:
    """The scans of a tissue that count, in `unit` ("kPa" or "ratio"), and how many do not: why -> number.

    groups: the same scans by patient.
    """

    tissue: str
    unit: str
    scans: tuple[Scan, ...]
    left_out: dict[str, int]
    groups: dict[str, list[Scan]]

    @property
    def patients(self) -> tuple[str, ...]:
        """Patients with a scan that counts, in the table's order."""
        return tuple(self.groups)

    def of(self, patient: str) -> tuple[Scan, ...]:
        """The scans of a patient."""
        return tuple(self.groups.get(patient, ()))

    def stage_of(self, patient: str) -> int | None:
        """The stage of a patient; None where its rows name none, or several."""
        stages = {scan.stage for scan in self.of(patient)}
        return stages.pop() if len(stages) == 1 else None


def usable_scans(records: Sequence[Record], tissue: str) -> Usable:
    """The scans of a tissue that count by `RULE`; where rows in kPa and ratios are mixed, those in kPa."""
    found = [(record.row, modulus) for record in records if (modulus := record.modulus(tissue)) is not None]
    unit = "kPa" if any(modulus.unit == "kPa" for _, modulus in found) else "ratio"
    scans: list[Scan] = []
    left_out = {"failed": sum(record.state == "failed" for record in records)}
    left_out |= {"waiting": sum(record.state == "waiting" for record in records), "not identified": 0, "other unit": 0}
    for row, modulus in found:
        if modulus.unit != unit:
            left_out["other unit"] += 1
        elif modulus.verdict == "not identified" or not (modulus.value and modulus.low95 and modulus.high95):
            left_out["not identified"] += 1
        else:
            sd = max(math.log(modulus.high95 / modulus.low95) / (2.0 * HALF_WIDTH), LEAST_SD)
            who = (row.id, row.patient, row.session, row.stage)
            scans.append(Scan(*who, modulus.value, modulus.low95, modulus.high95, sd, modulus.verdict))
    groups: dict[str, list[Scan]] = {}
    for scan in scans:
        groups.setdefault(scan.patient, []).append(scan)
    return Usable(tissue, unit, tuple(scans), left_out, groups)


def inside_fences(values: Array) -> NDArray[np.bool_]:
    """Which of the values (n,) lie no more than 1.5 interquartile ranges outside the quartiles."""
    low, high = np.percentile(values, [25.0, 75.0])
    reach = FENCE * (high - low)
    return np.asarray((values >= low - reach) & (values <= high + reach))
