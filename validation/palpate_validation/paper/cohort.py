"""A synthetic cohort in the shape of the paper's: 8 patients with a T stage each, 180 pairs of images between them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from palpate.approximation import LinearisationPoint, ReducedBasis, reduced_basis
from palpate.case import DriverMotion
from palpate.images import Role, Tissue
from palpate.inversion import Bounds, InverseProblem, InversionSettings, LaterState, StopRule, invert
from palpate.mechanics import Conditions, LinearModel, LinearSystem, linear_model, outer_constraint
from palpate.mesh import Anatomy, LagrangeSpace, lagrange_space, tetrahedralise
from palpate.observation import NoiseModel, observed_surface, prescribed_motion, surface_distance
from palpate.phantoms import (
    Noise,
    PelvisShapes,
    centred_grid,
    draw_pelvis,
    filling_of,
    grid_box,
    smooth_field,
)
from palpate.unknowns import parameter_map, unit_blocks
from palpate_validation.truth import target_of_truth

__all__ = ["ORGANS", "CohortSettings", "PatientResult", "estimate_patient", "patient_space", "true_moduli"]

Array = NDArray[np.float64]

ORGANS = ("prostate", "bladder")
SURROUNDINGS_KPA = 10.0
FIELD_MM = (110.0, 120.0, 120.0)
POISSON_RATIO = 0.45
SPREAD = 3.0  # the reduced model is made at the middle modulus, and at it times and over this factor
SEARCHED = (0.1, 100.0)  # bounds of the moduli, relative to the surroundings
RULE = StopRule(step_sd=0.1)


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


def estimate_patient(settings: CohortSettings, patient: int, progress: Callable[[str], None]) -> PatientResult:
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
    kept = [estimate for estimate in found if estimate.converged]
    return PatientResult(
        f"P{patient + 1}",
        settings.stages[patient],
        truth,
        {organ: [float(e.kpa[i]) for e in kept] for i, organ in enumerate(ORGANS)},
        len(found) - len(kept),
        3 * len(space.points),
        max((e.error_bound for e in found), default=0.0),
    )


@dataclass(frozen=True, slots=True)
class _Estimate:
    kpa: Array
    converged: bool
    error_bound: float


@dataclass(frozen=True, slots=True)
class _Pair:
    """One pair of images of a patient: its own filling of the rectum, its own noise of both surfaces."""

    settings: CohortSettings
    shapes: PelvisShapes
    basis: ReducedBasis
    system: LinearSystem
    rng: np.random.Generator

    def estimate(self) -> _Estimate:
        """Moduli (kPa) of both organs from the noisy surfaces of the pair, by the reduced model alone."""
        problem = self.problem()
        bounds = Bounds(*np.log(np.outer(SEARCHED, np.ones(len(ORGANS)))))
        settings = InversionSettings((np.log(np.full(len(ORGANS), 2.0)),), bounds)
        found = invert(problem, settings, progress=lambda _: None, rule=RULE).minimum
        coefficients = problem.parameters.coefficients(found.unknowns)[0]
        bound = self.basis.error(LinearisationPoint(problem.parameters.moduli(found.unknowns), coefficients)).relative
        return _Estimate(SURROUNDINGS_KPA * np.exp(found.unknowns[: len(ORGANS)]), found.converged, bound)

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
