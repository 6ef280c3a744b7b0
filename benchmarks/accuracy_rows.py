"""The rows of accuracy.py: random pelves with a known truth, and the inverse problems of their images."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from palpate.body import Body, aligned, edge_length_of, inverse_problem, make_body
from palpate.case import Case, Discrepancy, Domain, Mechanics, MeshSettings, Phantom
from palpate.images import Role, segment
from palpate.inversion import InverseProblem, InversionSettings, LaterState
from palpate.mechanics import ACCURACY, NewtonSettings, finite_strain_model, linear_model, outer_constraint
from palpate.mesh import LagrangeSpace, lagrange_space, tetrahedralise
from palpate.observation import observed_surface, prescribed_motion, surface_distance
from palpate.phantoms import (
    Noise,
    PelvisOptions,
    Scene,
    pelvis,
    pelvis_anatomy,
    pelvis_grid,
    reimaged,
)
from palpate.study import inversion_settings
from palpate.unknowns import parameter_map, wall_blocks
from palpate_validation.truth import exact_target, rescaled

__all__ = ["NOISE", "ROWS", "Posed", "Row", "Truths", "from_voxels", "posed", "truth_of"]

NOTHING_LEFT_OUT = Discrepancy(heterogeneity_sd=0.0, poisson_sd=0.0, surface_offset_mm=0.0)
NOISE = Noise(surface_sd_mm=0.3, correlation_length_mm=6.0)


@dataclass(frozen=True)
class Row:
    """One row of the table: how scenes are drawn, and what is shown to the estimate."""

    cases: int
    filling_mm: float | None = None  # None: 6 to 8 mm at random
    spacing_mm: tuple[float, float, float] = (1.0, 1.0, 1.0)
    noise: Noise | None = None
    tumour: bool = False
    data: str = "voxels"
    edge_mm: float | None = None  # None: the program's own choice
    truth_edge_mm: float = 3.4
    draws: int = 1  # of the noise, for each pelvis
    law: str = "linear"  # of the truth and of the estimate
    poisson_ratio: float | None = None  # None: 0.40 to 0.45 at random
    held: bool = True  # the frame, and all else that the model leaves out; False: the program's defaults


ROWS = {
    "same-mesh": Row(2, data="same mesh", truth_edge_mm=5.0),
    "other-mesh": Row(4, data="surfaces", edge_mm=4.0, truth_edge_mm=2.7),  # what exact surfaces show
    "clean": Row(8),
    "clean-3mm": Row(4, filling_mm=3.0),
    "noise": Row(8, spacing_mm=(1.0, 1.0, 2.5), noise=NOISE, draws=3),
    "tumour": Row(3, tumour=True),
    "nu-0.49": Row(4, poisson_ratio=0.49),
    "finite-clean": Row(6, law="neo-hookean"),
    "finite-clean-3mm": Row(3, law="neo-hookean", filling_mm=3.0),
    "finite-noise": Row(6, law="neo-hookean", spacing_mm=(1.0, 1.0, 2.5), noise=NOISE, draws=2),
}


Truths = dict[tuple[object, ...], tuple[Scene, float]]


def truth_of(row: Row, seed: int, draw: int, truths: Truths) -> tuple[Scene, PelvisOptions]:
    """The scene of a row; rows of one seed share the truth where they can, but not the images.

    A linear truth is linear in the filling; a finite-strain one is made anew.
    """
    filling = float(np.random.default_rng([seed, 7]).uniform(6.0, 8.0))
    if row.law != "linear" and row.filling_mm is not None:
        filling = row.filling_mm
    options = PelvisOptions(
        seed=seed,
        filling_mm=filling,
        tumour=row.tumour,
        law=row.law,
        poisson_ratio=row.poisson_ratio,
        truth_edge_mm=row.truth_edge_mm,
    )
    key = (row.tumour, row.law, row.poisson_ratio, row.truth_edge_mm, filling)
    if key not in truths:
        truths.clear()  # a truth is large
        truths[key] = pelvis(options), filling
    scene, made = truths[key]
    if row.filling_mm is not None and row.law == "linear":
        scene = rescaled(scene, row.filling_mm / made)
        filling = row.filling_mm
    options = replace(options, filling_mm=filling, spacing_mm=row.spacing_mm, noise=row.noise)
    return reimaged(replace(scene, seed=seed + 1000 * draw), pelvis_grid(options), noise=row.noise), options


@dataclass(frozen=True)
class Posed:
    """One case of a row: the scene, what is asked of it, and the body it was made of where images are seen."""

    scene: Scene
    filling_mm: float
    space: LagrangeSpace
    problem: InverseProblem
    settings: InversionSettings
    bodies: tuple[Body, ...]


def posed(row: Row, seed: int, draw: int, truths: Truths) -> Posed:
    """The scene of a row, and the inverse problem that its images or surfaces pose."""
    scene, options = truth_of(row, seed, draw, truths)
    case = Case(
        f"seed-{seed}",
        phantom=Phantom("pelvis", seed),
        mesh=MeshSettings(row.edge_mm),
        mechanics=Mechanics(row.law, "P2" if row.law == "linear" and row.poisson_ratio is None else "auto"),
        domain=Domain(outer_boundary="fixed") if row.held else Domain(),
        discrepancy=NOTHING_LEFT_OUT if row.held else Discrepancy(),
    )
    bodies: tuple[Body, ...] = ()
    if row.data == "voxels":
        problem, body = from_voxels(scene, case)
        space, bodies = body.space, (body,)
    else:
        space, problem = _from_surfaces(scene, case, options, row)
    return Posed(scene, options.filling_mm, space, problem, inversion_settings(case, problem.parameters), bodies)


def from_voxels(scene: Scene, case: Case) -> tuple[InverseProblem, Body]:
    """Everything from the label images: the inverse problem, and the body that it is made of."""
    before, after = (segment(image, scene.tissues) for image in (scene.before, scene.after))
    body = make_body(aligned(before, (after,), method="none"), case, progress=lambda _: None)
    return inverse_problem(body, case, progress=lambda _: None), body


def _from_surfaces(scene: Scene, case: Case, options: PelvisOptions, row: Row) -> tuple[LagrangeSpace, InverseProblem]:
    """The truth's surfaces as targets; on the same mesh also a wall motion that the modes can make."""
    same_mesh = row.data == "same mesh"
    if same_mesh:
        space = lagrange_space(scene.mesh, "P2")
    else:
        before, after = (segment(image, scene.tissues) for image in (scene.before, scene.after))
        edges = edge_length_of(case, before, (after,))
        anatomy = pelvis_anatomy(options)
        mesh = tetrahedralise(anatomy, edge_length_mm=edges.mm, longer_mm=edges.longer_mm)
        space = lagrange_space(mesh, "P2")
    driver = case.driver
    motion = prescribed_motion(
        space, {}, n_modes=driver.modes, kernel_mm=driver.kernel_mm, prior_mm=driver.prior_mm, fine=True
    )
    constraint = outer_constraint(
        space, outer="fixed", modes=motion.modes, offset=motion.offset, prescribed=motion.prescribed
    )
    model = linear_model(space, constraint)
    if same_mesh:
        rows = np.repeat(motion.prescribed, 3)
        q = np.asarray(np.linalg.lstsq(motion.modes[rows], scene.displacement.ravel()[rows])[0], dtype=np.float64)
        moduli = np.array([scene.moduli_kpa[name] for name in model.names])
        scene = replace(scene, displacement=model.solve(moduli, q).displacement)
    observed = [i for i, t in enumerate(scene.tissues) if t.role in (Role.ESTIMATE, Role.DRIVER)]
    seen = tuple(surface_distance(exact_target(scene, observed_surface(space, i))) for i in observed)
    mapping = parameter_map(scene.tissues, model.regions, [b for wall in motion.walls for b in wall_blocks(wall, 0)])
    law = case.mechanics.material_law
    finite = finite_strain_model(space, constraint, law, settings=NewtonSettings(ACCURACY)) if law.finite else None
    return space, InverseProblem((LaterState(model, seen, finite),), mapping)
