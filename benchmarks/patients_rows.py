"""What the rows of benchmarks/patients.py come to: errors and intervals by noise and images, and the stage's effect.

A row is one estimate of one patient. Rows of the cohort have a `stage`, 0 or 1, and do not enter the first table.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from palpate.cohort.records import Record, modulus_of
from palpate.cohort.statistics.document import statistics_document
from palpate.cohort.task import Row

__all__ = ["EFFECT", "figures_of", "stage_effects", "summary_of"]

Values = dict[str, Any]

EFFECT = {"prostate": 1.3, "bladder": 1.0}  # by which the higher stage's moduli are larger
STATED = ("identified", "weak")


def figures_of(results: Sequence[Mapping[str, Any]]) -> Values:
    """Both tables: {"rows": by noise and images, "cohort": {"rows": by organ}}, without rows where none is there."""
    return {"rows": summary_of(results), "cohort": {"rows": stage_effects(results)}}


def summary_of(results: Sequence[Mapping[str, Any]]) -> dict[str, Values]:
    """By noise and number of later images: patients, errors of ln E, half-widths, intervals that hold, cost.

    rms, error: root mean square and median of |ln E / truth| over all moduli with a value; half_width: median of half
    of ln(high / low) over all intervals with two ends; stated: moduli that are `identified` or `weak`; held: of these,
    those whose interval holds the truth; seconds: median time of processors; peak_gb: the largest. None: no row says.
    """
    found = dict[str, Values]()
    for kind, own in _kinds([row for row in results if row.get("stage") is None]).items():
        law, noise, images = kind
        items = [item for row in own for item in row.get("estimates", ())]
        errors = [abs(np.log(item["value"] / item["truth"])) for item in items if item["value"] is not None]
        intervals = [item["interval95"] for item in items if item["interval95"]]
        widths = [0.5 * np.log(high / low) for low, high in intervals if low and high]
        stated = [item for item in items if item["verdict"] in STATED]
        found[_name(*kind)] = {
            "law": law,
            "noise_mm": noise,
            "images": images,
            "patients": len(own),
            "failed": sum(row["status"] != "converged" for row in own),
            "moduli": len(items),
            "rms": _rounded(np.sqrt(np.mean(np.square(errors))) if errors else None),
            "error": _rounded(np.median(errors) if errors else None),
            "half_width": _rounded(np.median(widths) if widths else None),
            "stated": len(stated),
            "held": sum(_holds(item["interval95"], item["truth"]) for item in stated),
            "seconds": _rounded(_of(own, "processor_seconds", np.median), 1),
            "peak_gb": _rounded(_of(own, "peak_gb", np.max)),
        }
    return found


def stage_effects(results: Sequence[Mapping[str, Any]]) -> dict[str, Values]:
    """By organ: the factor of its moduli from the lower to the higher stage, as `palpate statistics` finds it.

    patients: of the lower and of the higher stage; stated, censored: those that the regression takes by their value,
    and by their interval alone; factor, interval95, p: of the regression of ln E on the stage; truth: the factor that
    the moduli were drawn with; drawn: ratio of the geometric means of those that were drawn, which scatters about it.
    """
    found = dict[str, Values]()
    kinds = _kinds([row for row in results if row.get("stage") is not None])
    for kind, own in kinds.items():
        document = statistics_document([_record(row) for row in own])
        for tissue, organ in document["organs"].items():
            regression = organ["regression"]
            drawn: tuple[list[float], list[float]] = ([], [])  # of each stage, ln E
            for row in own:
                truths = [item["truth"] for item in row.get("estimates", ()) if item["tissue"] == tissue]
                drawn[row["stage"]].extend(np.log(truths))
            found[tissue if len(kinds) == 1 else f"{tissue}, {_name(*kind)}"] = {
                "noise_mm": kind[1],
                "images": kind[2],
                "patients": [sum(row["stage"] == stage for row in own) for stage in (0, 1)],
                "stated": organ["used"]["scans"] - organ["used"]["censored"],
                "censored": organ["used"]["censored"],
                "factor": _rounded(regression.get("factor_per_stage")),
                "interval95": [_rounded(end) for end in regression.get("interval95", (None, None))],
                "p": _rounded(regression.get("p"), 3),
                "truth": EFFECT[tissue],
                "drawn": _rounded(np.exp(np.mean(drawn[1]) - np.mean(drawn[0])) if all(drawn) else None),
                "undefined": regression.get("undefined", ""),
            }
    return found


def _record(row: Mapping[str, Any]) -> Record:
    """A row of the cohort as the cohort's statistics take it: one scan of one patient."""
    name = f"{row['seed']}"
    of = Row(name, name, stage=row["stage"])
    if row["status"] != "converged":
        return Record(of, "failed", "solver", str(row["reason"]))
    moduli = tuple(modulus_of(item) for item in row["estimates"])
    return Record(of, "done", moduli=moduli, seconds=row["seconds"], warnings=tuple(row["warnings"]))


def _kinds(rows: Sequence[Mapping[str, Any]]) -> dict[tuple[str, float, int], list[Mapping[str, Any]]]:
    """The rows by law, noise (mm) and number of later images, in their order."""
    keys = sorted({(row["law"], row["noise_mm"], row["images"]) for row in rows})
    return {key: [row for row in rows if (row["law"], row["noise_mm"], row["images"]) == key] for key in keys}


def _name(law: str, noise: float, images: int) -> str:
    return f"{law}, {noise:g} mm, {images}"


def _holds(interval: Sequence[float | None], truth: float) -> bool:
    """Whether an interval holds the truth; an open end does."""
    low, high = interval
    return (low is None or low <= truth) and (high is None or truth <= high)


def _of(rows: Sequence[Mapping[str, Any]], key: str, what: Any) -> Any:
    """What the rows that have that key come to; None where none has it."""
    values = [row[key] for row in rows if key in row]
    return what(values) if values else None


def _rounded(value: Any, digits: int = 2) -> float | None:
    return None if value is None else round(float(value), digits)
