"""statistics.json: what a cohort says of modulus and stage, its unit of analysis, its rules, what cannot be said."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from typing import Any

import numpy as np

from palpate.cohort.records import Record, tissues_of
from palpate.cohort.statistics.association import association
from palpate.cohort.statistics.regression import stage_regression
from palpate.cohort.statistics.scans import RULES, Scan, Usable, combined, inside_fences, repeatability, usable_scans
from palpate.cohort.task import Row
from palpate.findings import MISLEADING
from palpate.statement.result import json_object

SCHEMA = "palpate.statistics/1"
SEED = 0
NOTES = [
    *RULES,
    "The unit of analysis is the patient. One test is made of each organ: that of `regression`. All else describes.",
    "regression: ln E of each scan on its patient's stage; patients scatter about the line, and scans about patients.",
    "A censored scan counts there by the probability of its interval.",
    "p: of all arrangements of the stages among up to 8 patients, else of 9999 seeded ones and the one that was seen.",
    "Interval of the factor: the slopes that this test does not reject.",
    "regression_adjusted: the same beside the table's further numeric columns, without a test.",
    "regression_without_warned: without scans whose warnings say that a modulus can be off by more than its interval.",
    "per_patient: correlations of the patients' medians; Kendall's tau takes pairs that intervals leave open as ties.",
    "What is said per scan takes all scans of a few patients for as many patients; it stands there for comparison.",
    "paper: mean, and Pearson's r, of scans with a value within 1.5 interquartile ranges of their patient's quartiles.",
    "The paper states no rule for outliers; this is the one that box plots draw them by.",
    "Association is no cause, and with few patients intervals are wide: read them before the p.",
]


def statistics_document(records: Sequence[Record]) -> dict[str, Any]:
    """The document statistics.json of a cohort's records, schema palpate.statistics/1."""
    tissues = [usable_scans(records, tissue) for tissue in tissues_of(records)]
    states = Counter(record.state for record in records)
    classes = Counter(record.failure_class for record in records if record.failure_class)
    holders: dict[str, list[tuple[Row, str]]] = {}  # of each image
    numeric: dict[str, dict[str, float]] = {}  # of the table's further columns: name -> id of a row -> number
    for record in records:
        for key, digest in record.images.items():
            holders.setdefault(digest, []).append((record.row, key))
        for name, text in record.row.covariates.items():
            try:
                number = float(text)
            except ValueError:
                number = math.nan
            numeric.setdefault(name, {})[record.row.id] = number
    covariates = {name: of for name, of in numeric.items() if any(map(math.isfinite, of.values()))}
    document = {
        "schema": SCHEMA,
        "unit_of_analysis": "patient",
        "rows": {"in": len(records), **{state: states[state] for state in ("done", "failed", "waiting")}},
        "failed_by_class": dict(classes),
        "identical_images": [  # that several patients share: an image that was copied, or one patient twice
            {
                "sha256": digest,
                "patients": patients,
                "rows": [{"id": row.id, "image": key} for row, key in held],
            }
            for digest, held in holders.items()
            if len(patients := list(dict.fromkeys(row.patient for row, _ in held))) > 1
        ],
        "patients": _patients(records, tissues),
        "organs": {usable.tissue: _organ(usable, covariates) for usable in tissues},
        "paper": {usable.tissue: _as_the_paper(usable) for usable in tissues},
        "notes": NOTES,
    }
    return json_object(document)


def _organ(usable: Usable, covariates: Mapping[str, Mapping[str, float]]) -> dict[str, Any]:
    staged = [patient for patient in usable.patients if usable.stage_of(patient) is not None]
    lows, highs = ([np.array([getattr(s, end) for s in usable.of(p)]) for p in staged] for end in ("low", "high"))
    stages = np.array([float(usable.stage_of(patient) or 0) for patient in staged])
    several = [p for p in usable.patients if len({scan.stage for scan in usable.of(p)}) > 1]
    remarks = [f"{len(several)} patients have rows of several stages: nothing by stage uses them"] if several else []
    without = len(usable.patients) - len(staged) - len(several)
    remarks += [f"{without} patients have no stage"] if without else []
    clean = [scan for scan in usable.scans if not set(scan.warnings) & set(MISLEADING)]
    warned = len(clean) < len(usable.scans)
    censored = sum(scan.value is None for scan in usable.scans)
    adjusted = stage_regression(usable.scans, covariates=covariates, seed=SEED) if covariates else None
    # quartiles of the scans of each stage
    found = []
    for stage in sorted({scan.stage for scan in usable.scans if scan.stage is not None}):
        scans = [scan for scan in usable.scans if scan.stage == stage]
        low, middle, high = _quantiles(scans)
        counts = {"n_patients": len({scan.patient for scan in scans}), "n_scans": len(scans)}
        counts["n_censored"] = sum(scan.value is None for scan in scans)
        found.append({"stage": stage, **counts, "q25": low, "median": middle, "q75": high})
    without_warned = stage_regression(clean, seed=SEED) if warned else {}
    untested = {key: value for key, value in without_warned.items() if key not in ("p", "arrangements", "exact")}
    return {
        "unit": usable.unit,
        "used": {"scans": len(usable.scans), "patients": len(usable.patients), "censored": censored},
        "left_out": usable.left_out,
        "left_out_rows": {"not identified": usable.unknown, "unfit": usable.unfit},
        "warnings": usable.warnings(),
        "remarks": remarks,
        **asdict(association(lows, highs, stages)),
        "regression": stage_regression(usable.scans, seed=SEED),
        "regression_adjusted": adjusted if adjusted is None or adjusted.get("covariates", True) else None,
        "regression_without_warned": untested if warned else None,
        "repeatability": repeatability(usable),
        "by_stage": found,
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
            if scans := usable.of(patient):
                valued = [scan for scan in scans if scan.value is not None]
                values = np.array([scan.low for scan in valued])
                inside = inside_fences(values) if valued else np.zeros(0, dtype=bool)
                entry["kpa" if usable.unit == "kPa" else "ratio"][usable.tissue] = [scan.value for scan in valued]
                entry["summary"][usable.tissue] = {  # null is what their values alone do not tell
                    "n": len(scans),
                    "outliers": int((~inside).sum()),
                    "median": _quantiles(scans)[1],
                    "mean_as_the_paper": float(values[inside].mean()) if valued else None,
                    "combined": asdict(combined(valued)) if valued else None,
                    "censored": [[scan.low95, scan.high95] for scan in scans if scan.value is None],
                }
        found.append(entry)
    return found


def _as_the_paper(usable: Usable) -> dict[str, Any]:
    """Pearson's r over scans without outliers, as if they were patients: what the paper computes, but for its p."""
    stages, values = list[float](), list[float]()
    for patient in usable.patients:
        scans = [scan for scan in usable.valued(patient) if scan.stage is not None]
        if scans:
            inside = inside_fences(np.array([scan.low for scan in scans]))
            stages += [float(scan.stage or 0) for scan, there in zip(scans, inside, strict=True) if there]
            values += [scan.low for scan, there in zip(scans, inside, strict=True) if there]
    if len(values) < 3 or len(set(stages)) < 2 or len(set(values)) < 2:
        return {"r": None, "n": len(values), "undefined": "undefined: too few scans, or all of one stage"}
    return {"r": float(np.corrcoef(stages, values)[0, 1]), "n": len(values)}


def _quantiles(scans: Sequence[Scan]) -> list[float | None]:
    """Quartiles of the scans; None where they would be others at another end of what is censored."""
    with np.errstate(invalid="ignore"):
        ends = [np.percentile([getattr(scan, end) for scan in scans], [25.0, 50.0, 75.0]) for end in ("low", "high")]
    return [float(low) if low == high else None for low, high in zip(*ends, strict=True)]
