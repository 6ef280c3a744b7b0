"""The paper's application: moduli against the T stage, in a simulated cohort of the same size."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray
from scipy import stats

from palpate.cohort.statistics.association import association
from palpate.cohort.statistics.regression import stage_regression
from palpate.cohort.statistics.scans import Scan
from palpate.report import interval_text, number
from palpate_validation.paper.cohort import ORGANS, CohortSettings, PatientResult, estimate_patient
from palpate_validation.paper.table import COLOURS, PAPER_STAGING, save_figure
from palpate_validation.scenes import Job, Part, Progress, Scenes

__all__ = ["Staging", "draw_staging", "paper_remark", "pearson_p", "points_behind", "staging", "with_stage"]

MOST_POINTS = 2000

KEYS = ("per_scan", "per_patient", "regression")
NOTES = (
    "All patients are simulated: random pelves, moduli that grow with the stage, noisy surfaces, no voxels.",
    "Data and estimates of a patient share one mesh, so this shows the statistics, not the accuracy of the method.",
    "A scan is not a patient: the p over scans treats all pairs of a few bodies as different bodies.",
    "per_patient: the patient is the unit; its test permutes the stages among the patients.",
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


def staging(settings: CohortSettings) -> Scenes[Staging]:
    """All patients, and how their moduli go with the stage."""
    keys = [f"patient {number + 1}" for number in range(len(settings.stages))]
    jobs = [Job((key,), partial(_part, settings, number)) for number, key in enumerate(keys)]

    def conclude(parts: Mapping[str, Part]) -> Staging:
        """The patients with their association."""
        patients = tuple(PatientResult(**parts[key]) for key in keys)
        stages = np.array([patient.stage for patient in patients], dtype=float)
        return Staging(patients, {organ: with_stage([p.kpa[organ] for p in patients], stages) for organ in ORGANS})

    return Scenes("staging", settings, jobs[::-1], conclude, draw_staging)  # the patients with most pairs first


def with_stage(kpa: Sequence[Sequence[float]], stages: NDArray[np.float64]) -> dict[str, Any]:
    """How the moduli (kPa) of each patient depend on the stages (n_patients,), per scan and per patient.

    The estimates have no intervals here.
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
    """The number of points that the paper's r and p imply, in a sentence."""
    counts = {organ: points_behind(r, p) for organ, (r, p) in PAPER_STAGING.items()}
    r, p = PAPER_STAGING["prostate"]
    patients = {organ: pearson_p(r, 8) for organ, (r, _) in PAPER_STAGING.items()}
    return (
        f"The paper's r = {r:g} has its p = {p:.2e} for n = {counts['prostate']} points (the bladder's for"
        f" n = {counts['bladder']}), not for its 8 patients or its 180 image sets. For 8 patients p would be"
        f" {patients['prostate']:.3f} (prostate) and {patients['bladder']:.2f} (bladder)."
    )


def _part(settings: CohortSettings, number: int, key: str, progress: Progress) -> dict[str, Any]:
    progress(f"staging: {key} of {len(settings.stages)}, {settings.pairs[number]} pairs of images")
    return asdict(estimate_patient(settings, number, progress))


def draw_staging(result: Staging, path: Path) -> None:
    """Box plots of the estimates by stage, a panel an organ (the paper's figures 7 and 8), into `path` (SVG)."""

    def draw(figure: Figure) -> None:
        """All panels."""
        panels = figure.subplots(1, len(result.organs))
        for axes, organ in zip(panels, result.organs, strict=True):
            stages = sorted({patient.stage for patient in result.patients})
            values = [[kpa for p in result.patients if p.stage == stage for kpa in p.kpa[organ]] for stage in stages]
            axes.boxplot(values, positions=stages, widths=0.5, showfliers=False)
            for order, patient in enumerate(result.patients):
                place = patient.stage + 0.04 * (order - 0.5 * (len(result.patients) - 1))
                label = ("", "") if order else ("patient, median", "patient, truth")
                median = float(np.median(patient.kpa[organ]))
                axes.plot(place, median, "o", color=COLOURS[0], markersize=4.0, label=label[0])
                axes.plot(place, patient.true_kpa[organ], "_", color=COLOURS[1], label=label[1])
            axes.set_xticks(stages, [f"T{stage}" for stage in stages])
            axes.legend(fontsize=7.5, frameon=False)
            axes.set_title(f"{organ} (simulated)")
            axes.set_xlabel("T stage")
            axes.set_ylabel("Young's modulus, kPa")

    save_figure(draw, path, width=8.5)


def pearson_p(r: float, n: int) -> float:
    """Two-tailed p of Pearson's r between n independent points: t = r sqrt((n - 2) / (1 - r^2)), Student's t."""
    t = abs(r) * np.sqrt((n - 2) / (1.0 - r**2))
    return float(2.0 * stats.t.sf(t, n - 2))


def points_behind(r: float, p: float) -> int:
    """The number n of points at which Pearson's r has the two-tailed p that is nearest to `p` (on a log scale)."""
    counts = range(3, MOST_POINTS)
    return min(counts, key=lambda n: abs(np.log(max(pearson_p(r, n), 1e-300) / p)))
