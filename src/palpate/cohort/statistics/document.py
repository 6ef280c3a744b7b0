"""statistics.json: what a cohort says of modulus and stage, its unit of analysis, its rules, what cannot be said."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from typing import Any

import numpy as np
from scipy import stats

from palpate.cohort.records import Record, tissues_of
from palpate.cohort.statistics.association import association
from palpate.cohort.statistics.models import combined, mixed_model, repeatability, weighted_regression
from palpate.cohort.statistics.scans import RULE, Usable, inside_fences, usable_scans
from palpate.cohort.task import Row
from palpate.study.result import json_object

__all__ = ["SCHEMA", "statistics_document"]

SCHEMA = "palpate.statistics/1"
SEED = 0
NOTES = [
    RULE,
    "The unit of analysis is the patient; its modulus is the median of its scans (per_patient).",
    "What is said per scan takes all scans of a few patients for as many patients; it stands there for comparison.",
    "Intervals of correlations come from drawing whole patients, 2000 times (Kendall's tau: 500).",
    "p-values of correlations take patients as independent.",
    "paper: mean, and Pearson's r, of all scans within 1.5 interquartile ranges of their patient's quartiles.",
    "The paper states no rule for outliers; this is the one that box plots draw them by.",
    "weighted: ln E of each patient on the stage, its scans combined by their intervals.",
    "mixed_model: ln E of each scan on the stage, with a random intercept for each patient.",
    "Its p, of the normal law, is too small for few patients.",
    "mixed_model_adjusted: the same beside the table's further numeric columns.",
    "Association is no cause, and with few patients intervals are wide: read them before the p-values.",
]


def statistics_document(records: Sequence[Record]) -> dict[str, Any]:
    """The document statistics.json of a cohort's records, schema palpate.statistics/1."""
    tissues = [usable_scans(records, tissue) for tissue in tissues_of(records)]
    states = Counter(record.state for record in records)
    classes = Counter(record.failure_class for record in records if record.failure_class)
    document = {
        "schema": SCHEMA,
        "unit_of_analysis": "patient",
        "rows": {"in": len(records), **{state: states[state] for state in ("done", "failed", "waiting")}},
        "failed_by_class": dict(classes),
        "patients": _patients(records, tissues),
        "organs": {usable.tissue: _organ(usable, records) for usable in tissues},
        "paper": {usable.tissue: _as_the_paper(usable) for usable in tissues},
        "notes": NOTES,
    }
    return json_object(document)


def _organ(usable: Usable, records: Sequence[Record]) -> dict[str, Any]:
    staged = [patient for patient in usable.patients if usable.stage_of(patient) is not None]
    values = [np.array([scan.value for scan in usable.of(patient)]) for patient in staged]
    stages = np.array([float(usable.stage_of(patient) or 0) for patient in staged])
    several = [p for p in usable.patients if len({scan.stage for scan in usable.of(p)}) > 1]
    remarks = (
        [f"{len(several)} patients have rows of several stages: only the mixed model uses them"] if several else []
    )
    without = len(usable.patients) - len(staged) - len(several)
    remarks += [f"{without} patients have no stage"] if without else []
    covariates = _numeric_covariates(records)
    return {
        "unit": usable.unit,
        "used": {"scans": len(usable.scans), "patients": len(usable.patients)},
        "left_out": usable.left_out,
        "remarks": remarks,
        **asdict(association(values, stages, seed=SEED)),
        "weighted": weighted_regression(usable),
        "mixed_model": mixed_model(usable, {}),
        "mixed_model_adjusted": mixed_model(usable, covariates) if covariates else None,
        "repeatability": repeatability(usable),
        "by_stage": _by_stage(usable),
    }


def _patients(records: Sequence[Record], tissues: Sequence[Usable]) -> list[dict[str, Any]]:
    found, of_patients = [], dict[str, list[Row]]()
    for record in records:
        of_patients.setdefault(record.row.patient, []).append(record.row)
    for patient, rows in of_patients.items():
        stages = {row.stage for row in rows}
        entry: dict[str, Any] = {"patient": patient, "stage": stages.pop() if len(stages) == 1 else None}
        entry |= {"sessions": [row.session for row in rows], "kpa": {}, "ratio": {}, "summary": {}}
        for usable in tissues:
            scans = usable.of(patient)
            if not scans:
                continue
            values = np.array([scan.value for scan in scans])
            entry["kpa" if usable.unit == "kPa" else "ratio"][usable.tissue] = values.tolist()
            inside = inside_fences(values)
            means = {"median": float(np.median(values)), "mean_as_the_paper": float(values[inside].mean())}
            outliers = {"n": len(values), "outliers": int((~inside).sum())}
            entry["summary"][usable.tissue] = outliers | means | {"combined": asdict(combined(scans))}
        found.append(entry)
    return found


def _as_the_paper(usable: Usable) -> dict[str, Any]:
    """Pearson's r over scans without outliers, with the p of as many patients: what the paper computes."""
    kept = []
    for patient in usable.patients:
        scans = [scan for scan in usable.of(patient) if scan.stage is not None]
        if scans:
            inside = inside_fences(np.array([scan.value for scan in scans]))
            kept += [scan for scan, there in zip(scans, inside, strict=True) if there]
    stages, values = [float(scan.stage or 0) for scan in kept], [scan.value for scan in kept]
    if len(kept) < 3 or len(set(stages)) < 2 or len(set(values)) < 2:
        return {"r": None, "p": None, "n": len(kept), "undefined": "undefined: too few scans, or all of one stage"}
    found = stats.pearsonr(stages, values)
    return {"r": float(found.statistic), "p": float(found.pvalue), "n": len(kept)}


def _by_stage(usable: Usable) -> list[dict[str, Any]]:
    """Quartiles of the scans of each stage."""
    found = []
    for stage in sorted({scan.stage for scan in usable.scans if scan.stage is not None}):
        scans = [scan for scan in usable.scans if scan.stage == stage]
        low, middle, high = np.percentile([scan.value for scan in scans], [25.0, 50.0, 75.0])
        counts = {"n_patients": len({scan.patient for scan in scans}), "n_scans": len(scans)}
        found.append({"stage": stage, **counts, "q25": low, "median": middle, "q75": high})
    return found


def _numeric_covariates(records: Sequence[Record]) -> Mapping[str, Mapping[str, float]]:
    """Name -> id of a row -> number, of the table's further columns that are numbers."""
    found: dict[str, dict[str, float]] = {}
    for record in records:
        for name, text in record.row.covariates.items():
            try:
                number = float(text)
            except ValueError:
                number = math.nan
            found.setdefault(name, {})[record.row.id] = number
    return {name: numbers for name, numbers in found.items() if any(map(math.isfinite, numbers.values()))}
