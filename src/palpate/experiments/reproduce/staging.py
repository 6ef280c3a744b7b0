"""The paper's application: moduli against the T stage, in a cohort that is simulated in the shape of its own."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from functools import partial
from typing import Any

import numpy as np

from palpate.cohort.statistics.association import Association, association, pearson_p, points_behind
from palpate.experiments.reproduce.cohort import ORGANS, CohortSettings, PatientResult, estimate_patient
from palpate.experiments.reproduce.jobs import Job, Progress, compute
from palpate.experiments.reproduce.ledger import Ledger
from palpate.experiments.reproduce.paper import PAPER_STAGING

__all__ = ["Staging", "paper_remark", "staging"]

NOTES = (
    "All patients are simulated: random pelves, moduli made to grow with the stage, noisy surfaces, no voxels.",
    "Data and estimates share one mesh a patient: this shows the statistics, not the accuracy of the method.",
    "A scan is not a patient: the p over scans takes all pairs of a few bodies for as many bodies.",
    "The patient is the unit here, with the median of its scans; the intervals come from drawing whole patients.",
)


@dataclass(frozen=True, slots=True)
class Staging:
    """All patients with their estimates, and each organ's association with the stage."""

    patients: tuple[PatientResult, ...]
    organs: dict[str, Association]

    def to_dict(self) -> dict[str, Any]:
        """As JSON."""
        return {
            "schema": "palpate.reproduce/1",
            "experiment": "staging",
            "patients": [asdict(patient) for patient in self.patients],
            "organs": {organ: asdict(found) for organ, found in self.organs.items()},
            "paper": {organ: {"r": r, "p": p} for organ, (r, p) in PAPER_STAGING.items()},
            "notes": [*NOTES, paper_remark()],
        }

    def text(self) -> list[list[str]]:
        """Rows of cells for a terminal."""
        rows = [["organ", "unit", "n", "r", "95 % (patients drawn)", "p", "rank rho", "the paper"]]
        for organ, found in self.organs.items():
            scan, patient, (r, p) = found.per_scan, found.per_patient, PAPER_STAGING[organ]
            theirs = f"r {r:g}, p {p:.2e}"
            rows.append(
                [organ, "scan", str(scan.n), f"{scan.r:.3f}", _range(scan.interval95), f"{scan.p:.2e}", "", theirs]
            )
            interval = _range(patient.interval95)
            rho = f"{patient.rho:.3f}"
            rows.append([organ, "patient", str(patient.n), f"{patient.r:.3f}", interval, f"{patient.p:.2e}", rho, ""])
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
    organs = {
        organ: association([np.array(p.kpa[organ]) for p in patients], stages, seed=settings.seed) for organ in ORGANS
    }
    return Staging(patients, organs)


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


def _range(interval: tuple[float, float] | None) -> str:
    return "undefined" if interval is None else f"{interval[0]:.2f} to {interval[1]:.2f}"
