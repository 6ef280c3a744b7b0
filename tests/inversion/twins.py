"""Twin problems: two balls beside a driver, deformed and observed on one mesh, exactly or through voxels."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cache

import numpy as np

from palpate.approximation import reduced_basis
from palpate.images.distance import tissue_distance_map
from palpate.images.segmentation import segment
from palpate.images.tissue import Role, Tissue
from palpate.inversion import Bounds, InverseProblem, InversionSettings, LaterState, Objective, with_first_noise
from palpate.mechanics.boundary import outer_constraint
from palpate.mechanics.linear_model import LinearModel, linear_model
from palpate.mesh.anatomy import Anatomy, Box
from palpate.mesh.space import lagrange_space
from palpate.mesh.tet_mesh import TetMesh
from palpate.mesh.tetrahedralise import tetrahedralise
from palpate.observation.observed_surface import observed_surface
from palpate.observation.prescribed_motion import prescribed_motion
from palpate.observation.surface_distance import surface_distance
from palpate.observation.target import surface_target
from palpate.phantoms.motion import smooth_field
from palpate.phantoms.scene import Scene, centred_grid, imaged
from palpate.phantoms.shapes import ball
from palpate.unknowns import parameter_map, unit_blocks
from palpate_validation.truth import exact_target, target_of_truth

BALLS = (ball([0.0, -9.0, -4.0], 8.0), ball([0.0, -4.0, 11.0], 7.0), ball([0.0, 9.0, -2.0], 7.0))
BOX = Box(np.full(3, -22.0), np.eye(3), np.full(3, 44.0))
TRUTH = np.log([3.0, 2.0])  # moduli of gland and sac, to the rest's
WALL_MM = 3.0
SMOOTHING = 0.6  # voxels


@dataclass(frozen=True)
class Twin:
    """A deformed body: its model, its scene, moduli (kPa) and mode coefficients that deformed it."""

    model: LinearModel
    scene: Scene
    moduli: np.ndarray
    coefficients: np.ndarray

    @property
    def surfaces(self):
        return [observed_surface(self.scene.space, tissue) for tissue in range(3)]

    @property
    def unknowns(self):
        return np.concatenate([TRUTH, self.coefficients])


def make_twin(*, element="P1", rest_kpa=10.0, voxel_mm=1.5, seed=5, edge_length_mm=6.0, truth=TRUTH) -> Twin:
    """The driver pushes gland and sac; where `rest_kpa` is None, the rest is to be estimated, too."""
    return deformed(model_of(element, rest_kpa, edge_length_mm), voxel_mm=voxel_mm, seed=seed, truth=truth)


@cache
def model_of(element, rest_kpa, edge_length_mm) -> LinearModel:
    """Its model, which all motions of one body share."""
    role = Role.KNOWN if rest_kpa else Role.ESTIMATE
    mesh = body_mesh(edge_length_mm)
    rest = replace(mesh.tissues[3], role=role, youngs_modulus_kpa=rest_kpa)
    space = lagrange_space(replace(mesh, tissues=(*mesh.tissues[:3], rest)), element)
    motion = prescribed_motion(space, {}, n_modes=12, kernel_mm=12.0, prior_mm=WALL_MM)
    given = {"modes": motion.modes, "offset": motion.offset, "prescribed": motion.prescribed}
    return linear_model(space, outer_constraint(space, outer="fixed", **given))


@cache
def body_mesh(edge_length_mm) -> TetMesh:
    """Its mesh, which takes longer than all else that is made of it."""
    tissues = (
        Tissue("gland", Role.ESTIMATE, (1,)),
        Tissue("sac", Role.ESTIMATE, (2,)),
        Tissue("tube", Role.DRIVER, (3,)),
        Tissue("rest", Role.KNOWN, (4,), youngs_modulus_kpa=10.0),
    )
    return tetrahedralise(Anatomy(tissues, (*BALLS, None), BOX), edge_length_mm=edge_length_mm)


def deformed(model, *, voxel_mm=1.5, seed=5, truth=TRUTH) -> Twin:
    space = model.space
    moduli = (space.mesh.tissues[3].youngs_modulus_kpa or 1.0) * np.append(np.exp(truth), 1.0)
    coefficients = np.random.default_rng(seed).standard_normal(model.n_modes)
    displacement = model.solve(moduli, coefficients).displacement
    grid = centred_grid((44.0,) * 3, (voxel_mm,) * 3)
    before, after = (imaged(space, motion, grid) for motion in (np.zeros_like(displacement), displacement))
    return Twin(model, Scene(space, displacement, before, after, {}, seed), moduli, coefficients)


def problem_of(twins, targets, noise=None, tied=()) -> InverseProblem:
    models = [twin.model for twin in twins]
    mapping = parameter_map(
        twins[0].scene.tissues, models[0].regions, unit_blocks(*(m.n_modes for m in models)), tied=tied
    )
    observations = [tuple(surface_distance(t, stated_noise=noise) for t in of_state) for of_state in targets]
    states = [LaterState(m, o, reference=i) for i, (m, o) in enumerate(zip(models, observations, strict=True))]
    return InverseProblem(tuple(states), mapping)


def exact_problem(*twins, noise=None, tied=()) -> InverseProblem:
    """The images are the model's own triangles."""
    return problem_of(twins, tuple(tuple(exact_target(t.scene, s) for s in t.surfaces) for t in twins), noise, tied)


def noisy_problem(twin, *, sd_mm, seed, correlation_mm=6.0) -> InverseProblem:
    """The images are the model's own triangles, each image's moved by a smooth random field of its own."""
    rng = np.random.default_rng(seed)
    fields = [smooth_field(rng, sd_mm=sd_mm, correlation_mm=correlation_mm, features=400) for _ in range(2)]
    space, displacement = twin.scene.space, twin.scene.displacement
    warps = tuple((lambda places, field=field: places + field.at(places)) for field in fields)
    return problem_of((twin,), (tuple(target_of_truth(space, displacement, s, warps=warps) for s in twin.surfaces),))


def voxel_problem(*twins, bias=0.0, noise=None) -> InverseProblem:
    """The images are voxels; `bias` (mm) is added to every distance map."""
    return problem_of(twins, tuple(tuple(voxel_target(t, s, bias) for s in t.surfaces) for t in twins), noise)


def voxel_target(twin, surface, bias=0.0):
    states = [segment(image, twin.scene.tissues) for image in (twin.scene.before, twin.scene.after)]
    width = SMOOTHING * float(states[0].grid.spacing.max())
    maps = [tissue_distance_map(state, surface.tissue, smoothing_mm=width).shifted(bias) for state in states]
    return surface_target(surface, *maps)


def objective_of(problem, coefficients=None) -> Objective:
    """By its first noise, on reduced bases of equal ratios, with series where the drivers move by coefficients."""
    parameters = problem.parameters
    moduli = parameters.moduli(np.zeros(parameters.n_parameters))
    bases = [reduced_basis(state.model, moduli) for state in problem.states]
    if coefficients is not None:
        bases = [basis.with_modulus_series(coefficients, parameters.selection) for basis in bases]
    return with_first_noise(Objective(problem.states, parameters).with_approximations(bases))


def settings(*ratios, limits=(0.02, 200.0), n=2, **others) -> InversionSettings:
    """All n log-moduli start at each of `ratios`, between `limits`."""
    starts = tuple(np.full(n, np.log(ratio)) for ratio in ratios)
    return InversionSettings(starts, Bounds(*np.log(np.outer(limits, np.ones(n)))), **others)


def silent(_message):
    pass
