"""The paper's application: moduli against the T stage, in a simulated cohort of 8 patients with 180 pairs of images."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray
from scipy import stats

from palpate.approximation import LinearisationPoint, ReducedBasis, reduced_basis
from palpate.case import DriverMotion
from palpate.cohort.statistics.association import association
from palpate.cohort.statistics.regression import stage_regression
from palpate.cohort.statistics.scans import Scan
from palpate.images import Role, Tissue
from palpate.inversion import Bounds, InverseProblem, InversionSettings, LaterState, StopRule, invert
from palpate.mechanics import Conditions, LinearModel, LinearSystem, linear_model, outer_constraint
from palpate.mesh import Anatomy, LagrangeSpace, lagrange_space, tetrahedralise
from palpate.observation import NoiseModel, observed_surface, prescribed_motion, surface_distance
from palpate.phantoms import Noise, PelvisShapes, centred_grid, draw_pelvis, filling_of, grid_box, smooth_field
from palpate.report import interval_text, number
from palpate.unknowns import parameter_map, unit_blocks
from palpate_validation.paper.table import COLOURS, PAPER_STAGING, save_figure
from palpate_validation.scenes import Job, Part, Progress, Scenes
from palpate_validation.truth import target_of_truth

__all__ = [
    "ORGANS",
    "CohortSettings",
    "PatientResult",
    "Staging",
    "draw_staging",
    "estimate_patient",
    "paper_remark",
    "patient_space",
    "pearson_p",
    "points_behind",
    "staging",
    "true_moduli",
    "with_stage",
]

Array = NDArray[np.float64]

ORGANS = ("prostate", "bladder")
SURROUNDINGS_KPA = 10.0
FIELD_MM = (110.0, 120.0, 120.0)
POISSON_RATIO = 0.45
SPREAD = 3.0  # the reduced model is made at the middle modulus, and at it times and over this factor
SEARCHED = (0.1, 100.0)  # bounds of the moduli, relative to the surroundings
RULE = StopRule(step_sd=0.1)
MOST_POINTS = 2000

KEYS = ("per_scan", "per_patient", "regression")
NOTES = (
    "All patients are simulated: random pelves, moduli that grow with the stage, noisy surfaces, no voxels.",
    "Data and estimates of a patient share one mesh, so this shows the statistics, not the accuracy of the method.",
    "A scan is not a patient: the p over scans treats all pairs of a few bodies as different bodies.",
    "per_patient: the patient is the unit; its test permutes the stages among the patients.",
)


@dataclass(frozen=True, slots=True)
class CohortSettings:
    """The cohort: its stages and numbers of pairs, a patient each, and how the truth depends on the stage.

    moduli (kPa) at stage 1 and their growth a stage, with the patients' own scatter (sd of ln E) on top.
    """

    stages: tuple[int, ...] = (1, 1, 2, 2, 3, 3, 3, 4)
    pairs: tuple[int, ...] = (15, 18, 20, 22, 24, 25, 27, 29)
    first_kpa: tuple[float, float] = (20.0, 18.0)
    growth: tuple[float, float] = (1.35, 1.12)
    scatter: tuple[float, float] = (0.15, 0.20)
    edge_mm: float = 9.5
    filling_mm: tuple[float, float] = (5.0, 9.0)
    noise: Noise = field(default_factory=lambda: Noise(0.3, 6.0))
    driver: DriverMotion = field(default_factory=lambda: DriverMotion(modes=60))
    seed: int = 11


@dataclass(frozen=True, slots=True)
class PatientResult:
    """One patient: true moduli and those of every pair (kPa) by organ; the model's size and certified error."""

    patient: str
    stage: int
    true_kpa: dict[str, float]
    kpa: dict[str, list[float]]
    not_converged: int
    dofs: int
    largest_error_bound: float


def true_moduli(settings: CohortSettings, patient: int) -> dict[str, float]:
    """True moduli (kPa) of a patient's organs."""
    rng = np.random.default_rng([settings.seed, patient])
    stage = settings.stages[patient]
    return {
        organ: float(first * growth ** (stage - 1) * np.exp(scatter * rng.standard_normal()))
        for organ, first, growth, scatter in zip(
            ORGANS, settings.first_kpa, settings.growth, settings.scatter, strict=True
        )
    }


def patient_space(settings: CohortSettings, patient: int) -> tuple[PelvisShapes, LagrangeSpace]:
    """A patient's random pelvis, and the P2 space on its mesh; raises `PalpateError`s of meshing."""
    box = grid_box(centred_grid(FIELD_MM, (1.0, 1.0, 1.0)))
    shapes = draw_pelvis(np.random.default_rng(settings.seed + patient), box, bones=False)
    tissues = (
        Tissue("prostate", Role.ESTIMATE, (1,), POISSON_RATIO),
        Tissue("bladder", Role.ESTIMATE, (2,), POISSON_RATIO),
        Tissue("rectum", Role.DRIVER, (3,)),
        Tissue("surroundings", Role.KNOWN, (4,), POISSON_RATIO, SURROUNDINGS_KPA),
    )
    anatomy = Anatomy(tissues, (shapes.prostate, shapes.bladder, shapes.rectum, None), box)
    return shapes, lagrange_space(tetrahedralise(anatomy, edge_length_mm=settings.edge_mm), "P2")


def estimate_patient(settings: CohortSettings, patient: int, progress: Progress) -> PatientResult:
    """All pairs of a patient, with one mesh and one reduced model; raises `PalpateError`s of meshing and solving."""
    truth, seed = true_moduli(settings, patient), settings.seed + patient
    shapes, space = patient_space(settings, patient)
    motion = prescribed_motion(
        space, {}, n_modes=settings.driver.modes, kernel_mm=settings.driver.kernel_mm, prior_mm=settings.driver.prior_mm
    )
    constraint = outer_constraint(
        space, outer="fixed", modes=motion.modes, offset=motion.offset, prescribed=motion.prescribed
    )
    model = linear_model(space, constraint)
    progress(f"patient {patient + 1}: {3 * len(space.points)} unknowns")
    basis = _basis(model)
    held = replace(model.constraint, modes=np.zeros((3 * len(space.points), 0)))
    system = model.with_conditions(Conditions(held)).system(_moduli(model, truth))
    pairs = [
        _Pair(settings, shapes, basis, system, np.random.default_rng([seed, number]))
        for number in range(settings.pairs[patient])
    ]
    found = [pair.estimate() for pair in pairs]
    kept = [kpa for kpa, converged, _ in found if converged]
    return PatientResult(
        f"P{patient + 1}",
        settings.stages[patient],
        truth,
        {organ: [float(kpa[i]) for kpa in kept] for i, organ in enumerate(ORGANS)},
        len(found) - len(kept),
        3 * len(space.points),
        max((bound for _, _, bound in found), default=0.0),
    )


@dataclass(frozen=True, slots=True)
class _Pair:
    """One pair of images of a patient: its own filling of the rectum, its own noise of both surfaces."""

    settings: CohortSettings
    shapes: PelvisShapes
    basis: ReducedBasis
    system: LinearSystem
    rng: np.random.Generator

    def estimate(self) -> tuple[Array, bool, float]:
        """Moduli (kPa) of both organs by the reduced model alone; whether they converged; the model's largest error."""
        problem = self.problem()
        bounds = Bounds(*np.log(np.outer(SEARCHED, np.ones(len(ORGANS)))))
        settings = InversionSettings((np.log(np.full(len(ORGANS), 2.0)),), bounds)
        found = invert(problem, settings, progress=lambda _: None, rule=RULE).minimum
        coefficients = problem.parameters.coefficients(found.unknowns)[0]
        bound = self.basis.error(LinearisationPoint(problem.parameters.moduli(found.unknowns), coefficients)).relative
        return SURROUNDINGS_KPA * np.exp(found.unknowns[: len(ORGANS)]), found.converged, bound

    def problem(self) -> InverseProblem:
        """The patient's model and the surfaces of this pair."""
        noise, space = self.settings.noise, self.system.model.space
        draws = [
            smooth_field(r, sd_mm=noise.surface_sd_mm, correlation_mm=noise.correlation_length_mm, features=500)
            for r in self.rng.spawn(2)
        ]
        u = self.displacement()
        tissues = space.mesh.tissues
        observed = [i for i, t in enumerate(tissues) if t.role in (Role.ESTIMATE, Role.DRIVER)]
        warps = (draws[0].warp, draws[1].warp)
        stated = NoiseModel(np.array([2.0 * noise.surface_sd_mm**2]), np.array([noise.correlation_length_mm]))
        targets = [target_of_truth(space, u, observed_surface(space, i), warps=warps) for i in observed]
        model = self.basis.full_model
        state = LaterState(model, tuple(surface_distance(target, stated_noise=stated) for target in targets))
        mapping = parameter_map(tissues, model.regions, unit_blocks(model.n_modes))
        return InverseProblem((state.with_approximation(self.basis),), mapping)

    def displacement(self) -> Array:
        """Displacement (n_points, 3) mm of the truth under a filling of its own."""
        model = self.system.model
        mesh = model.space.mesh
        motion = filling_of(
            self.shapes.rectum,
            filling_mm=float(self.rng.uniform(*self.settings.filling_mm)),
            fullest_mm=float(self.rng.uniform(-6.0, 6.0)),
            length_mm=float(self.rng.uniform(18.0, 24.0)),
            towards=self.shapes.forwards,
            lean=float(self.rng.uniform(0.0, 0.2)),
            stray=smooth_field(self.rng, sd_mm=0.0, correlation_mm=20.0, features=1),
        )
        offset = np.zeros_like(model.space.points)
        wall = np.unique(model.space.facets(mesh.boundary[mesh.beyond == mesh.tissue_index("rectum")]))
        offset[wall] = motion.at(model.space.points[wall])
        filled = model.with_conditions(Conditions(replace(model.constraint, offset=offset.ravel())))
        return replace(self.system, model=filled).solve(np.zeros(0)).displacement


def _basis(model: LinearModel) -> ReducedBasis:
    """One reduced model for all pairs: responses at five places of the two moduli."""
    middle = 2.5 * SURROUNDINGS_KPA
    basis = reduced_basis(model, _moduli(model, dict.fromkeys(ORGANS, middle)))
    none = np.zeros(model.n_modes)
    for first in (middle / SPREAD, middle * SPREAD):
        for second in (middle / SPREAD, middle * SPREAD):
            basis = basis.with_responses(_moduli(model, dict(zip(ORGANS, (first, second), strict=True))), none)
    return basis


def _moduli(model: LinearModel, organs: dict[str, float]) -> Array:
    """Moduli (n_regions,) kPa, the surroundings' beside the organs'."""
    return np.array([organs.get(name, SURROUNDINGS_KPA) for name in model.names])


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
