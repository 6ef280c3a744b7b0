"""The scans that the statistics of a cohort are made of, a patient's modulus from all of them, how well they repeat."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import stats
from statsmodels.stats.meta_analysis import combine_effects

from palpate.cohort.records import Record
from palpate.cohort.selection import NOTHING_KNOWN, OTHER_UNIT, UNFIT, unfit_codes, unit_of, why_left_out
from palpate.uncertainty import NORMAL_95
from palpate.uncertainty.intervals import within_subject_cv

RULES = (
    "A scan enters when its row is done. One that is not identified has no value: it enters as censored, by its ends.",
    "Of a scan that is not identified and has no end, nothing is known: it is left out, counted and named.",
    f"So is one with a warning that its images or its case are wrong: {', '.join(UNFIT)}.",
    "None of these warnings looks at the modulus that was found. Scans with other warnings enter and are counted.",
)
LEAST_SD = 1e-3  # of ln E: nothing is known better
FENCE = 1.5  # Tukey's, which box plots draw their outliers by (Exploratory Data Analysis, 1977)

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Scan:
    """One row's modulus of one tissue; `value` None where it is censored: all that is known are its ends.

    low95, high95: of the 95 % interval, None for an open end; warnings: codes that the row's result carries.
    """

    id: str
    patient: str
    session: str
    stage: int | None
    value: float | None
    low95: float | None
    high95: float | None
    warnings: tuple[str, ...] = ()

    @property
    def low(self) -> float:
        """The smallest that its modulus can be: its value, or the lower end, 0 where that is open."""
        return self.value or self.low95 or 0.0

    @property
    def high(self) -> float:
        """The largest that its modulus can be: its value, or the upper end, infinity where that is open."""
        return self.value or self.high95 or math.inf

    @property
    def sd(self) -> float:
        """Standard deviation of its logarithm by its 95 % interval; of a scan with a value."""
        return max(math.log((self.high95 or 1.0) / (self.low95 or 1.0)) / (2.0 * NORMAL_95), LEAST_SD)


@dataclass(frozen=True, slots=True)
class Usable:
    """The scans of a tissue that enter, in `unit` ("kPa" or "ratio"), and how many do not: why -> number.

    unfit: id of a row -> the warnings that leave it out; unknown: ids of those that no end is known of; groups: the
    scans by patient.
    """

    tissue: str
    unit: str
    scans: tuple[Scan, ...]
    left_out: dict[str, int]
    unfit: dict[str, list[str]]
    unknown: list[str]
    groups: dict[str, list[Scan]]

    @property
    def patients(self) -> tuple[str, ...]:
        """Patients with a scan that enters, in the table's order."""
        return tuple(self.groups)

    def of(self, patient: str) -> tuple[Scan, ...]:
        """The scans of a patient."""
        return tuple(self.groups.get(patient, ()))

    def valued(self, patient: str) -> tuple[Scan, ...]:
        """Those that have a value."""
        return tuple(scan for scan in self.of(patient) if scan.value is not None)

    def stage_of(self, patient: str) -> int | None:
        """The stage of a patient; None where its rows name none, or several."""
        stages = {scan.stage for scan in self.of(patient)}
        return stages.pop() if len(stages) == 1 else None

    def warnings(self) -> dict[str, int]:
        """Code of a warning -> number of the scans that enter with it."""
        return dict(Counter(code for scan in self.scans for code in scan.warnings))


def usable_scans(records: Sequence[Record], tissue: str) -> Usable:
    """The scans of a tissue that enter by `RULES`; where rows in kPa and ratios are mixed, those in kPa."""
    found = [(record, modulus) for record in records if (modulus := record.modulus(tissue)) is not None]
    unit = unit_of(records, tissue)
    scans, unfit, unknown, other = list[Scan](), dict[str, list[str]](), list[str](), 0
    for record, modulus in found:
        row, why = record.row, why_left_out(record, tissue, unit)
        if why == OTHER_UNIT:
            other += 1
        elif why == NOTHING_KNOWN:
            unknown.append(row.id)
        elif why:
            unfit[row.id] = unfit_codes(record)
        else:
            who, ends = (row.id, row.patient, row.session, row.stage), (modulus.low95, modulus.high95)
            value = modulus.value if all(modulus.stated) else None
            scans.append(Scan(*who, value, *ends, record.warnings))
    states = Counter(record.state for record in records)
    left_out = {"failed": states["failed"], "waiting": states["waiting"]}
    left_out |= {"not identified": len(unknown), "unfit": len(unfit), "other unit": other}
    groups: dict[str, list[Scan]] = {}
    for scan in scans:
        groups.setdefault(scan.patient, []).append(scan)
    return Usable(tissue, unit, tuple(scans), left_out, unfit, unknown, groups)


def inside_fences(values: Array) -> NDArray[np.bool_]:
    """Which of the values (n,) lie no more than 1.5 interquartile ranges outside the quartiles."""
    low, high = np.percentile(values, [25.0, 75.0])
    reach = FENCE * (high - low)
    return np.asarray((values >= low - reach) & (values <= high + reach))


@dataclass(frozen=True, slots=True)
class Combined:
    """A patient's modulus from all its scans and their intervals, `sd` that of its logarithm."""

    value: float
    low95: float
    high95: float
    sd: float


def combined(scans: Sequence[Scan]) -> Combined:
    """Random-effects mean of the scans' ln E with the variances that their intervals state (Paule & Mandel 1982).

    The scans have values.
    """
    logs, variances = np.log([scan.low for scan in scans]), np.array([scan.sd for scan in scans]) ** 2
    mean, sd = float(logs[0]), float(np.sqrt(variances[0]))
    if len(scans) > 1:
        found = combine_effects(logs, variances, method_re="iterated")
        mean, sd = float(found.mean_effect_re), float(found.sd_eff_w_re)
    ends = mean + sd * np.array([-1.0, 1.0]) * stats.norm.ppf(0.975)
    return Combined(float(np.exp(mean)), float(np.exp(ends[0])), float(np.exp(ends[1])), sd)


def repeatability(usable: Usable) -> dict[str, Any]:
    """Within-patient variation and ICC(1) of ln E, from a one-way analysis of variance (Shrout & Fleiss 1979).

    Of the scans with a value. With unequal numbers of scans, n0 = (N - sum n^2 / N) / (k - 1) stands for their number;
    the interval of the ICC, exact for equal ones, is then approximate.
    """
    valued = [scans for patient in usable.patients if (scans := usable.valued(patient))]
    groups = [np.log([scan.low for scan in scans]) for scans in valued]
    counts = np.array([len(group) for group in groups])
    total, k = int(counts.sum()), len(groups)
    if k < 2 or total <= k:
        return {"undefined": "undefined: two patients are needed, and one of them with two scans that have a value"}
    within = sum(float(((group - group.mean()) ** 2).sum()) for group in groups) / (total - k)
    found: dict[str, Any] = {"within_patient_sd_ln": within**0.5, "within_patient_cv": float(within_subject_cv(within))}
    found |= {"n_scans": total, "n_patients": k}
    if within == 0.0:
        return found | {"undefined": "undefined: all scans of each patient have the same modulus"}
    ratio = float(stats.f_oneway(*groups).statistic)
    n0 = (total - float((counts**2).sum()) / total) / (k - 1)
    ends = [ratio / stats.f.ppf(q, k - 1, total - k) for q in (0.975, 0.025)]
    icc, *interval = [float((f - 1.0) / (f - 1.0 + n0)) for f in (ratio, *ends)]
    return found | {"icc": icc, "icc_interval95": interval}
