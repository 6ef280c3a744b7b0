"""From the images of a case to a body that can be computed with: alignment, mesh, space, motion, targets."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from palpate.errors import ConfigurationError, ResourceError
from palpate.images.alignment import RigidMotion, align, moved
from palpate.images.checks import check_images
from palpate.images.distance import DistanceMap, observation_width, smoothing_width
from palpate.images.finding import Finding
from palpate.images.segmentation import Segmentation
from palpate.images.tissue import Role
from palpate.images.tissue_distance import tissue_distance_map
from palpate.inversion import InverseProblem, LaterState, parameter_map
from palpate.mechanics.boundary import outer_constraint
from palpate.mechanics.dilatation import choose_element
from palpate.mechanics.equilibrium import ACCURACY
from palpate.mechanics.finite_strain import FiniteStrainModel, finite_strain_model
from palpate.mechanics.laws.contract import Law
from palpate.mechanics.linear_model import LinearModel, linear_model, with_constraint
from palpate.mechanics.newton import NewtonSettings
from palpate.mesh.anatomy import Anatomy, Box, anatomy_of, domain_box, margin_box
from palpate.mesh.quality import MeshQuality, check_mesh
from palpate.mesh.space import LagrangeSpace, lagrange_space
from palpate.mesh.tetrahedralise import tetrahedralise
from palpate.observation.contract import Observation
from palpate.observation.noise_model import NoiseModel
from palpate.observation.observed_surface import ObservedSurface, observed_surface
from palpate.observation.prescribed_motion import prescribed_motion
from palpate.observation.surface_distance import surface_distance
from palpate.observation.target import surface_target
from palpate.observation.wall_modes import Wall
from palpate.parallel import mapped
from palpate.study.case import Case
from palpate.study.case_loads import case_loads
from palpate.study.contacts import every_finding
from palpate.study.refusals import refuse_lost, refuse_unmeshable

__all__ = [
    "Body",
    "ImagedStates",
    "aligned",
    "case_domain",
    "inverse_problem",
    "joint_problem",
    "make_body",
    "stated_noise",
    "surface_observations",
]

THIN_VOXELS = 4
STATED = (
    "motion-below-noise",
    "sides-exchanged",
    "front-exchanged",
)  # findings on contacts stand in the result as observed shares


@dataclass(frozen=True, slots=True)
class ImagedStates:
    """The reference state and the later states, brought to it; `bones`: each later state's motions by tissue index.

    `inputs`: SHA-256 of each file that was read for them, by its key in `result.json`; `alignments`: each later
    state's motion from the first image's world to its own, of all bones as one body; none where nothing was aligned.
    """

    before: Segmentation
    after: tuple[Segmentation, ...]
    bones: tuple[Mapping[int, RigidMotion], ...]
    findings: tuple[Finding, ...]
    inputs: Mapping[str, str] = field(default_factory=dict)
    alignments: tuple[RigidMotion, ...] = ()


@dataclass(frozen=True, slots=True)
class Body:
    """A meshed reference state with its images; `smoothing_mm` is the width of every distance map that is compared."""

    states: ImagedStates
    space: LagrangeSpace
    quality: MeshQuality
    smoothing_mm: float


def aligned(
    before: Segmentation, after: tuple[Segmentation, ...], *, method: str, loaded: bool = False
) -> ImagedStates:
    """Bring the later images to the first on their rigid tissues (`method` "rigid-tissues") and check them all.

    `loaded`: whether known loads act on the body, for what is found of its motion.
    Raises `InputDataError` as `check_images`, `align` and `refuse_lost` do, `GeometryError` as `refuse_unmeshable`.
    """
    images, bones, findings, alignments = [], [], list[Finding](), list[RigidMotion]()
    for number, image in enumerate(after, start=1):
        if method == "none":
            images.append(image)
            bones.append(dict[int, RigidMotion]())
            continue
        alignment = align(before, image)
        alignments.append(alignment.overall.motion)
        images.append(moved(image, alignment.overall.motion.inverse()))
        rigid = {i: t.name for i, t in enumerate(before.tissues) if t.role is Role.RIGID}
        bones.append({i: alignment.remaining(name) for i, name in rigid.items()})
        findings += [
            Finding(
                "rigid-unseen",
                f"after image {number}: '{name}' shows too little of its surface for a motion of its own; it moves with"
                " the other rigid tissues",
            )
            for name, fit in alignment.tissues.items()
            if fit.n_points == 0
        ]
        findings += [
            Finding(
                "several-bodies",
                f"after image {number}: a piece of '{name}' lies {off:.1f} mm off the motion of the whole, which"
                " moves as one body; give each bone its own tissue",
            )
            for name, off in alignment.loose.items()
        ]
        findings += [
            Finding(
                "rotation-undetermined",
                f"after image {number}: the surface of '{name}' does not show its rotation about"
                f" {len(fit.undetermined)} of three axes; it is taken as not turning about them",
            )
            for name, fit in alignment.tissues.items()
            if len(fit.undetermined)
        ]
    findings += check_images(before, images)
    refuse_unmeshable(before, "before")
    for number, image in enumerate(images, start=1):
        name = "after" if len(images) == 1 else f"after[{number}]"
        refuse_unmeshable(image, name)
        refuse_lost(before, image, name)
    findings += [finding for finding in every_finding(before, images, loaded=loaded) if finding.code in STATED]
    return ImagedStates(before, tuple(images), tuple(bones), tuple(findings), alignments=tuple(alignments))


def make_body(states: ImagedStates, case: Case, *, progress: Callable[[str], None]) -> Body:
    """Mesh the reference state of the images; raises `MeshQualityError` when the mesh does not pass its gate."""
    before = states.before
    width = smoothing_width(before.grid, *(image.grid for image in states.after))
    box = case_domain(before, states.after, case)
    anatomy = anatomy_of(before, box=box, smoothing_mm=width)
    progress(f"meshing {np.round(box.lengths).astype(int).tolist()} mm at {case.mesh.edge_length_mm:g} mm")
    try:
        mesh = tetrahedralise(anatomy, edge_length_mm=case.mesh.edge_length_mm)
    except RuntimeError as error:  # Mmg's own words, which do not tell a lack of memory from a bad surface
        raise ResourceError(
            f"the mesher stopped ({error}), most likely for want of memory; make mesh.edge_length_mm larger, or the"
            ' domain smaller (domain.extent = "margin")'
        ) from error
    quality = _gate(states.before, anatomy, mesh_box=box, mesh=lagrange_space(mesh, "P1"))
    space = lagrange_space(mesh, choose_element(case.mechanics.element).space)
    progress(
        f"{quality.tets} tetrahedra, {3 * len(space.points)} unknowns, smallest dihedral angle"
        f" {quality.min_dihedral_deg:.1f} degrees"
    )
    return Body(states, space, quality, observation_width(before.grid, *(image.grid for image in states.after)))


def inverse_problem(body: Body, case: Case, *, progress: Callable[[str], None]) -> InverseProblem:
    """Models and targets of every later image; raises `ConfigurationError` when nothing moves the body."""
    return joint_problem((body,), case, progress=progress)


def joint_problem(bodies: Sequence[Body], case: Case, *, progress: Callable[[str], None]) -> InverseProblem:
    """The same of several reference states of one patient: one set of moduli, the bodies' images one after the other.

    All bodies have the same tissues in the same order. Raises as `inverse_problem` does.
    """
    noise = stated_noise(case)
    seen = [(r, o) for r, body in enumerate(bodies) for o in surface_observations(body, stated_noise=noise)]
    progress("assembling one stiffness matrix a tissue")
    pairs = [pair for body in bodies for pair in _models(body, case)]
    models = tuple(model for model, _ in pairs)
    _refuse_rest(models, case)
    finite = _finite_strain(models, case)
    states = tuple(
        LaterState(model, observations, law, walls if case.driver.learn_prior else (), reference)
        for (model, walls), law, (reference, observations) in zip(pairs, finite, seen, strict=True)
    )
    tissues, n_modes = bodies[0].space.mesh.tissues, [model.n_modes for model in models]
    return InverseProblem(states, parameter_map(tissues, models[0].regions, n_modes, loaded=bool(case.loads)))


def stated_noise(case: Case) -> NoiseModel | None:
    """The noise model of the residuals that a case states: both images' surfaces have it; None: from the residuals."""
    if case.noise.surface_sd_mm is None:
        return None
    length = case.noise.correlation_length_mm or 6.0
    return NoiseModel(np.array([2.0 * case.noise.surface_sd_mm**2]), np.array([length]))


def surface_observations(
    body: Body, surfaces: Sequence[ObservedSurface] | None = None, *, stated_noise: NoiseModel | None = None
) -> tuple[tuple[Observation, ...], ...]:
    """The observed surfaces of each later image; `surfaces` None: of all `estimate` tissues and drivers."""
    tissues = body.space.mesh.tissues
    observed = [i for i, tissue in enumerate(tissues) if tissue.role in (Role.ESTIMATE, Role.DRIVER)]
    seen = [observed_surface(body.space, i) for i in observed] if surfaces is None else surfaces

    def maps(image: Segmentation) -> list[DistanceMap]:
        """The distance map of each surface's tissue."""
        return mapped(lambda s: tissue_distance_map(image, s.tissue, smoothing_mm=body.smoothing_mm), seen)

    before = maps(body.states.before)
    return tuple(
        tuple(
            surface_distance(surface_target(*of), stated_noise=stated_noise)
            for of in zip(seen, before, maps(image), strict=True)
        )
        for image in body.states.after
    )


def _models(body: Body, case: Case) -> list[tuple[LinearModel, tuple[Wall, ...]]]:
    """One model a later image, and its drivers' walls; they share the stiffness and differ in the bones' motion."""
    models: list[tuple[LinearModel, tuple[Wall, ...]]] = []
    dilatation, loads = choose_element(case.mechanics.element).dilatation, case_loads(case, body.space)
    for bones in body.states.bones:
        motion = prescribed_motion(
            body.space,
            bones,
            n_modes=case.driver.modes,
            kernel_mm=case.driver.kernel_mm,
            prior_mm=case.driver.prior_mm,
        )
        constraint = outer_constraint(
            body.space,
            outer=case.domain.outer_boundary,
            modes=motion.modes,
            offset=motion.offset,
            prescribed=motion.prescribed,
        )
        made = (
            with_constraint(models[0][0], constraint)
            if models
            else linear_model(body.space, constraint, dilatation=dilatation, loads=loads, solver=case.mechanics.solver)
        )
        models.append((made, motion.walls))
    return models


def _finite_strain(models: tuple[LinearModel, ...], case: Case) -> Sequence[FiniteStrainModel | None]:
    """The same bodies under the case's law; None where that is the linear one."""
    law = case.mechanics.material_law
    if not law.finite:
        return [None] * len(models)
    found: list[FiniteStrainModel] = []
    for model in models:
        like = next((other for other in found if other.space is model.space), None)
        found.append(like.under(model.constraint) if like else _finite_strain_model(model, law, case))
    return found


def _finite_strain_model(model: LinearModel, law: Law, case: Case) -> FiniteStrainModel:
    dilatation = choose_element(case.mechanics.element).dilatation
    settings = NewtonSettings(tolerance=ACCURACY, solver=case.mechanics.solver)
    return finite_strain_model(
        model.space,
        model.constraint,
        law,
        dilatation=dilatation,
        loads=case_loads(case, model.space),
        settings=settings,
    )


def _refuse_rest(models: tuple[LinearModel, ...], case: Case) -> None:
    """Without a motion or a load, every modulus explains the images equally badly."""
    if not case.loads and not any(model.n_modes or model.constraint.offset.any() for model in models):
        raise ConfigurationError(
            'nothing moves this body: no tissue has role = "driver" and no `rigid` tissue moves between the images, so'
            " no modulus can be estimated; give the role driver to the hollow organ whose wall deforms the others"
        )


def case_domain(before: Segmentation, after: Sequence[Segmentation], case: Case) -> Box:
    """The box that is meshed: what the images share, or with extent "margin" its part around organs and drivers.

    Raises `GeometryError` when the images share no volume.
    """
    box = domain_box([before.grid, *(image.grid for image in after)])
    if case.domain.extent == "image":
        return box
    shown = [i for i, tissue in enumerate(before.tissues) if tissue.role in (Role.ESTIMATE, Role.DRIVER)]
    voxels = np.argwhere(np.isin(before.index, shown)).astype(float)
    return margin_box(box, before.grid.world(voxels), margin_mm=case.domain.margin_mm)


def _gate(before: Segmentation, anatomy: Anatomy, *, mesh_box: Box, mesh: LagrangeSpace) -> MeshQuality:
    """Pass the mesh through its gate; voxels are counted inside the domain."""
    index = np.argwhere(np.ones(before.grid.shape, dtype=bool))
    local = mesh_box.local(before.grid.world(index.astype(float)))
    inside = np.all((local > 0.0) & (local < mesh_box.lengths), axis=1).reshape(before.grid.shape)
    volumes = {
        tissue.name: float(np.count_nonzero(inside & before.mask(i))) * before.grid.voxel_volume
        for i, tissue in enumerate(before.tissues)
        if tissue.meshed
    }
    return check_mesh(mesh.mesh, anatomy, voxel_volumes=volumes, thin=_thin(before))


def _thin(before: Segmentation) -> tuple[str, ...]:
    """Names of meshed tissues that are under four voxels thick along some axis."""
    thin = []
    for i, tissue in enumerate(before.tissues):
        mask = before.mask(i)
        spans = [np.flatnonzero(mask.any(axis=tuple({0, 1, 2} - {a}))) for a in range(3)]
        if tissue.meshed and min(span[-1] - span[0] + 1 for span in spans if len(span)) < THIN_VOXELS:
            thin.append(tissue.name)
    return tuple(thin)
