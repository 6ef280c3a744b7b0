"""The paper's application: moduli against the T stage, in a cohort that is simulated in the shape of its own."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from palpate.cohort.statistics.association import association, pearson_p, points_behind
from palpate.cohort.statistics.regression import stage_regression
from palpate.cohort.statistics.scans import Scan
from palpate.experiments.reproduce.cohort import ORGANS, CohortSettings, PatientResult, estimate_patient
from palpate.experiments.reproduce.jobs import Job, Progress, compute
from palpate.experiments.reproduce.ledger import Ledger
from palpate.experiments.reproduce.paper import PAPER_STAGING
from palpate.report import interval_text, number

__all__ = ["Staging", "paper_remark", "staging", "with_stage"]

KEYS = ("per_scan", "per_patient", "regression")
NOTES = (
    "All patients are simulated: random pelves, moduli made to grow with the stage, noisy surfaces, no voxels.",
    "Data and estimates share one mesh a patient: this shows the statistics, not the accuracy of the method.",
    "A scan is not a patient: the p over scans takes all pairs of a few bodies for as many bodies.",
    "The patient is the unit here: its test takes all arrangements of the stages among the patients.",
)


@dataclass(frozen=True, slots=True)
class Staging:
    """All patients with their estimates, and each organ's association with the stage (`with_stage`)."""

    patients: tuple[PatientResult, ...]
    organs: Mapping[str, Mapping[str, Any]]

    def to_dict(self) -> dict[str, Any]:
        """As JSON."""
        return {
            "schema": "palpate.reproduce/1",
            "experiment": "staging",
            "patients": [asdict(patient) for patient in self.patients],
            "organs": dict(self.organs),
            "paper": {organ: {"r": r, "p": p} for organ, (r, p) in PAPER_STAGING.items()},
            "notes": [*NOTES, paper_remark()],
        }

    def text(self) -> list[list[str]]:
        """Rows of cells for a terminal."""
        rows = [["organ", "unit", "n", "r", "p", "rank rho", "factor a stage", "95 %", "the paper"]]
        for organ, found in self.organs.items():
            scan, patient, line, (r, p) = *(found[key] for key in KEYS), PAPER_STAGING[organ]
            theirs = f"r {r:g}, p {p:.2e}"
            rows.append([organ, "scan", str(scan["n"]), f"{scan['r']:.3f}", f"{scan['p']:.2e}", "", "", "", theirs])
            numbers = [f"{patient['r']:.3f}", f"{line['p']:.2e}", f"{patient['rho']:.3f}"]
            factor = [number(line["factor_per_stage"]), interval_text(tuple(line["interval95"]))]
            rows.append([organ, "patient", str(patient["n"]), *numbers, *factor, ""])
        return rows


def staging(settings: CohortSettings, ledger: Ledger, *, progress: Progress, workers: int = 1) -> Staging:
    """Estimate all patients by that many processes, then ask how their moduli go with the stage.

    Raises `PalpateError`s of meshing and solving.
    """
    keys = [f"patient {number + 1}" for number in range(len(settings.stages))]
    jobs = [Job((key,), partial(_part, settings, number)) for number, key in enumerate(keys)]
    parts = compute(jobs[::-1], ledger, workers=workers, progress=progress)  # the patients with most pairs first
    patients = tuple(PatientResult(**parts[key]) for key in keys)
    stages = np.array([patient.stage for patient in patients], dtype=float)
    return Staging(patients, {organ: with_stage([p.kpa[organ] for p in patients], stages) for organ in ORGANS})


def with_stage(kpa: Sequence[Sequence[float]], stages: NDArray[np.float64]) -> dict[str, Any]:
    """What the moduli (kPa) of each patient have to do with stages (n_patients,), per scan and per patient.

    Estimates have no intervals here: they scatter as they do.
    """
    values = [np.array(part) for part in kpa]
    found = asdict(association(values, values, stages))
    found["per_scan"]["p"] = pearson_p(found["per_scan"]["r"], found["per_scan"]["n"])
    scans = [
        Scan(f"{i}-{j}", f"{i}", "", int(stage), value, value, value)
        for i, (part, stage) in enumerate(zip(kpa, stages, strict=True))
        for j, value in enumerate(part)
    ]
    return found | {"regression": stage_regression(scans)}


def paper_remark() -> str:
    """What the paper's r and p say of its number of points."""
    counts = {organ: points_behind(r, p) for organ, (r, p) in PAPER_STAGING.items()}
    r, p = PAPER_STAGING["prostate"]
    patients = {organ: pearson_p(r, 8) for organ, (r, _) in PAPER_STAGING.items()}
    return (
        f"The paper's r = {r:g} gives its p = {p:.2e} at n = {counts['prostate']} points and at no other number near it"
        f" (the bladder's at n = {counts['bladder']}), neither its 8 patients nor its 180 image sets; for 8 patients"
        f" p would be {patients['prostate']:.3f} (prostate) and {patients['bladder']:.2f} (bladder)."
    )


def _part(settings: CohortSettings, number: int, key: str, progress: Progress) -> dict[str, Any]:
    progress(f"staging: {key} of {len(settings.stages)}, {settings.pairs[number]} pairs of images")
    return asdict(estimate_patient(settings, number, progress))
