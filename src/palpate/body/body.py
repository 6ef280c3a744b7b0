"""From the images of a case to a body that can be computed with: mesh, space, motion, unknowns, targets."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from palpate.body.cost import ExpectedCost, cost_of_meshes
from palpate.body.edge_length import EdgeLength
from palpate.body.imaged import ImagedStates
from palpate.body.loads import case_loads
from palpate.body.meshing import ReferenceMesh, mesh_reference
from palpate.body.poisson_ratios import sought_priors, with_ratios
from palpate.body.refusals import NOTHING_MOVES
from palpate.case.case import Case
from palpate.errors import ConfigurationError
from palpate.findings import Finding
from palpate.images.distance import observation_width
from palpate.images.tissue import Role
from palpate.inversion import InverseProblem, LaterState
from palpate.mechanics.boundary import Conditions, outer_constraint
from palpate.mechanics.dilatation import choose_element
from palpate.mechanics.equilibrium import ACCURACY
from palpate.mechanics.finite_strain import FiniteStrainModel, finite_strain_model
from palpate.mechanics.linear_model import LinearModel, linear_model
from palpate.mechanics.loads import boundary_named
from palpate.mechanics.material import MaterialModes, material_modes
from palpate.mechanics.newton import NewtonSettings
from palpate.mechanics.reaction import SurfaceReaction, surface_reaction
from palpate.mesh.layers import Layer, layer_thickness_mm, layered_space, layers_round_organs
from palpate.mesh.quality import MeshQuality, mesh_figures
from palpate.mesh.space import LagrangeSpace, lagrange_space
from palpate.mesh.tet_mesh import TetMesh
from palpate.observation.contract import Imaged, ImagedBody, Observation, OfInstrument
from palpate.observation.drawn_at_rest import UNIT_MM, modes_at_rest
from palpate.observation.noise_model import NoiseModel
from palpate.observation.prescribed_motion import FrameMotion, PrescribedMotion, bone_offset, prescribed_motion
from palpate.observation.registry import observations
from palpate.observation.surface_distance import SurfaceDistance
from palpate.parallel import blas_on_one_thread
from palpate.progress import Line, Progress, grouped
from palpate.unknowns import (
    Block,
    frame_blocks,
    instrument_block,
    known_modulus_blocks,
    layer_blocks,
    material_blocks,
    offset_block,
    parameter_map,
    reference_block,
    sought_ratio_blocks,
    unit_blocks,
    wall_blocks,
)


@dataclass(frozen=True, slots=True)
class Body:
    """A meshed reference state with its images.

    `measured`: the data terms beside the images, by the number of their later state among all; `smoothing_mm`: the
    width of every distance map that is compared; `edge_length`: the mesh's at the organs with its reason, None where it
    was made otherwise; `findings`: of the mesh; `layers`: regions that models have besides;
    `strained` (n_points, 3) mm: how far the loads of the reference state have moved it from where it is free of stress,
    see `unloaded_displacement`; None: not at all, or that is not known yet.
    """

    states: ImagedStates
    space: LagrangeSpace
    quality: MeshQuality
    smoothing_mm: float
    edge_length: EdgeLength | None = None
    findings: tuple[Finding, ...] = ()
    measured: tuple[tuple[int, Observation], ...] = ()
    layers: tuple[Layer, ...] = ()
    strained: NDArray[np.float64] | None = None

    @property
    def layered(self) -> LagrangeSpace:
        """The space that models are made on: layers round organs are regions of their own."""
        return layered_space(self.space, self.layers)

    def imaged(self, stated_noise: NoiseModel | None = None) -> ImagedBody:
        """What observations are made of, under the noise that a case states."""
        states = self.states
        return ImagedBody(self.space, states.before, states.after, self.smoothing_mm, stated_noise)


@blas_on_one_thread()
def make_body(states: ImagedStates, case: Case, *, progress: Progress, mesh: TetMesh | None = None) -> Body:
    """Mesh the reference state of the images (see `mesh_reference`), unless a `mesh` is given; raises as that does."""
    element = choose_element(case.mechanics.element).space
    known = states.mesh if mesh is None else replace(mesh, tissues=states.before.tissues)
    if known is not None:
        found = ReferenceMesh(known, mesh_figures(known))
    else:
        found = mesh_reference(states.before, states.after, case, progress=progress)
    space = lagrange_space(found.mesh, element)
    progress(Line(f"{grouped(found.quality.tets)} tetrahedra", "mesh"))
    progress(f"{3 * len(space.points)} unknowns, smallest dihedral angle {found.quality.min_dihedral_deg:.1f} degrees")
    layers = layers_round_organs(found.mesh) if case.discrepancy.layer_sd else ()
    width = observation_width(states.before.grid, *(image.grid for image in states.after))
    body = Body(states, space, found.quality, width, found.edge_length, found.findings, layers=layers)
    measured, findings = _measured(body, case)
    return replace(body, measured=measured, findings=(*body.findings, *findings))


def cost_of_bodies(bodies: Sequence[Body], case: Case) -> ExpectedCost:
    """What an estimate on the very meshes of these bodies costs."""
    sizes = [(body.quality.tets, 3 * len(body.space.points)) for body in bodies]
    first = bodies[0].states
    return cost_of_meshes(case, first.before, sizes, n_after=len(first.later))


def strained_body(body: Body, strained: NDArray[np.float64], case: Case) -> Body:
    """The body whose reference state lies `strained` (n_points, 3) mm from where it is free of stress."""
    return _remade(body, case, strained=strained)


def body_with_ratios(body: Body, ratios: Mapping[str, float], case: Case) -> Body:
    """The body whose tissues have these Poisson's ratios, by their names."""
    return _remade(body, case, space=with_ratios(body.space, ratios))


def on_linear_elements(body: Body, case: Case) -> Body:
    """The body on linear elements of its mesh, without the strain of its reference: coarse, and quick."""
    return _remade(body, case, space=lagrange_space(body.space.mesh, "P1"), strained=None)


def _remade(body: Body, case: Case, **changes: Any) -> Body:
    """The body with these changes; measurements are attached to it anew."""
    found = replace(body, **changes)
    return replace(found, measured=_measured(found, case)[0])


def _measured(body: Body, case: Case) -> tuple[tuple[tuple[int, Observation], ...], tuple[Finding, ...]]:
    """The data terms beside the images, by the number of their state, and the findings on them."""
    mechanics, space = case.mechanics, body.space

    def reaction_of(name: str, direction: NDArray[np.float64]) -> SurfaceReaction:
        """The force that holds a named surface."""
        return surface_reaction(
            body.layered,
            boundary_named(space.mesh, name),
            direction,
            mechanics.material_law,
            dilatation=choose_element(mechanics.element).dilatation,
            material=_material(space.mesh, body.layers, case),
            strained=body.strained,
        )

    terms = [(source.file.state, *source.on(space, reaction_of)) for source in body.states.data]
    return tuple((state, term) for state, term, _ in terms), tuple(f for _, _, of_term in terms for f in of_term)


def inverse_problem(body: Body, case: Case, *, progress: Progress) -> InverseProblem:
    """Models and targets of every later image; raises `ConfigurationError` when nothing moves the body."""
    return joint_problem((body,), case, progress=progress)


def joint_problem(bodies: Sequence[Body], case: Case, *, progress: Progress, earlier: int = 0) -> InverseProblem:
    """The same of several reference states of one patient: one set of moduli, the bodies' images one after the other.

    All bodies have the same tissues in the same order. earlier: number of images that are compared with the reference
    besides. Raises as `inverse_problem` does.
    """
    shared = tuple(layer for layer in bodies[0].layers if all(layer in body.layers for body in bodies))
    bodies = [body if body.layers == shared else _remade(body, case, layers=shared) for body in bodies]
    progress("distances to the surfaces of all images")
    noise = stated_noise(case)
    seen = [(r, observed) for r, body in enumerate(bodies) for observed in _observed(body, noise)]
    progress("assembling the stiffness matrix of each tissue")
    pairs = [pair for body in bodies for pair in _models(body, case)]
    models = tuple(model for model, _ in pairs)
    if not case.known_force and not any(motion.walls or model.constraint.offset.any() for model, motion in pairs):
        raise ConfigurationError(NOTHING_MOVES)  # at rest every modulus explains the images equally badly
    strained = [body.strained for body in bodies for _ in body.states.later]
    finite = _finite_strain(models, strained, case)
    drawn = _drawn_at_rest(seen, earlier)
    states = tuple(
        LaterState(model, observations, law, reference, at_rest={of.name: of.modes for of in drawn if s in of.states})
        for s, (model, law, (reference, observations)) in enumerate(zip(models, finite, seen, strict=True))
    )
    blocks = _blocks(case, bodies[0], pairs, seen, drawn)
    tissues, regions = models[0].space.mesh.tissues, models[0].regions
    return InverseProblem(states, parameter_map(tissues, regions, blocks, loaded=case.known_force))


def _observed(body: Body, stated_noise: NoiseModel | None) -> Iterator[tuple[Observation, ...]]:
    """What is observed of each later state: surfaces, where it is imaged, and what was measured."""
    later, imaged = body.states.later, iter(observations(body.imaged(stated_noise)) if body.states.after else ())
    for of in later:
        surfaces = next(imaged) if of.image is not None else ()
        yield (*surfaces, *(term for number, term in body.measured if number == of.number))


def _blocks(
    case: Case,
    body: Body,
    pairs: Sequence[tuple[LinearModel, PrescribedMotion]],
    seen: Sequence[tuple[int, tuple[Observation, ...]]],
    drawn: Sequence[_DrawnAtRest],
) -> tuple[Block, ...]:
    """All that is unknown beside the moduli: of each later state its motion and its drawing, then the material.

    How reference images are drawn stands between them. The known modulus then, and one unknown an organ of all layers
    round it, as thick as they are in `body`.
    """
    blocks = list[Block]()
    for s, ((_, motion), (_, observed)) in enumerate(zip(pairs, seen, strict=True)):
        blocks += [b for wall in motion.walls for b in wall_blocks(wall, s, learned=case.driver.learn_prior)]
        blocks += frame_blocks(motion, s)
        if case.discrepancy.surface_offset_mm:
            sd = case.discrepancy.surface_offset_mm
            blocks += [offset_block(o, s, sd=sd) for o in observed if isinstance(o, Imaged)]
        for o in observed:
            if isinstance(o, OfInstrument) and o.offset_sd:
                blocks.append(instrument_block(o.name, s, sd=o.offset_sd))
    blocks += [reference_block(of.name, of.states, of.covariances, unit_mm=UNIT_MM) for of in drawn]
    priors = sought_priors(body.states.before.tissues, body.space.mesh.tissues, case)
    references = [reference for reference, _ in seen]
    for reference in dict.fromkeys(references):
        states = tuple(s for s, own in enumerate(references) if own == reference)
        model = pairs[states[0]][0]
        blocks += material_blocks(
            model.material,
            model.space.mesh,
            states,
            heterogeneity_sd=case.discrepancy.heterogeneity_sd,
            poisson_sd=case.discrepancy.poisson_sd,
            n_sought=len(priors),
        )
    every, mesh, regions = tuple(range(len(pairs))), body.space.mesh, pairs[0][0].regions
    numbered = list(enumerate(body.layers, start=len(mesh.tissues)))
    of = [
        (
            mesh.tissues[organ].name,
            tuple(regions.index(number) for number, layer in numbered if layer.organ == organ),
            layer_thickness_mm(mesh, body.layers, organ),
        )
        for organ in dict.fromkeys(layer.organ for layer in body.layers)
    ]
    believed = {"sd": case.discrepancy.layer_sd, "thickness_mm": case.discrepancy.layer_mm}
    return (
        *(blocks or unit_blocks(*(0 for _ in pairs))),
        *sought_ratio_blocks(priors, every),
        *known_modulus_blocks(pairs[0][0].space.mesh.tissues, regions, every),
        *layer_blocks(of, every, **believed),
    )


class _DrawnAtRest(NamedTuple):
    """A surface of a reference image, which several later `states` are compared with: see `modes_at_rest`."""

    name: str
    states: tuple[int, ...]
    modes: NDArray[np.float64]
    covariances: tuple[NDArray[np.float64], ...]


def _drawn_at_rest(seen: Sequence[tuple[int, tuple[Observation, ...]]], earlier: int) -> tuple[_DrawnAtRest, ...]:
    """Those of all references; of a single later image, and of a wall that moves freely, the noise says as much."""
    found = dict[tuple[int, str], list[tuple[int, SurfaceDistance]]]()
    for s, (reference, observed) in enumerate(seen):
        for o in observed:
            if isinstance(o, SurfaceDistance) and not o.of_driver:
                found.setdefault((reference, o.name), []).append((s, o))
    return tuple(
        _DrawnAtRest(name, tuple(s for s, _ in of), *modes_at_rest(of[0][1].target.surface))
        for (_, name), of in found.items()
        if len(of) + earlier > 1
    )


def stated_noise(case: Case) -> NoiseModel | None:
    """The noise model of the residuals that a case states: both images' surfaces have it; None: from the residuals."""
    if case.noise.surface_sd_mm is None:
        return None
    length = case.noise.correlation_length_mm or 6.0
    return NoiseModel(np.array([2.0 * case.noise.surface_sd_mm**2]), np.array([length]))


def _models(body: Body, case: Case) -> list[tuple[LinearModel, PrescribedMotion]]:
    """One model a later image, and what is prescribed; they share the stiffness and differ in their conditions."""
    models: list[tuple[LinearModel, PrescribedMotion]] = []
    moving, domain = case.domain.outer_boundary == "moving", case.domain
    frame = FrameMotion(domain.outer_motion_mm, domain.outer_kernel_mm) if moving else None
    dilatation, layered = choose_element(case.mechanics.element).dilatation, body.layered
    for later in body.states.later:
        loads = case_loads(case, body.space, later.number)
        if models:  # the same walls and frame, which move otherwise
            model, motion = models[0]
            motion = replace(motion, offset=bone_offset(body.space, later.bones))
            constraint = replace(model.constraint, offset=motion.offset)
            models.append((model.with_conditions(Conditions(constraint, loads)), motion))
            continue
        motion = prescribed_motion(
            body.space,
            later.bones,
            n_modes=case.driver.modes,
            kernel_mm=case.driver.kernel_mm,
            prior_mm=case.driver.prior_mm,
            fine=True,
            frame=frame,
        )
        constraint = outer_constraint(
            body.space,
            outer=case.domain.outer_boundary,
            modes=motion.modes,
            offset=motion.offset,
            prescribed=motion.prescribed,
        )
        made = linear_model(
            layered,
            constraint,
            dilatation=dilatation,
            loads=loads,
            solver=case.mechanics.solver,
            material=_material(body.space.mesh, body.layers, case),
        )
        models.append((made, motion))
    return models


def _material(mesh: TetMesh, layers: Sequence[Layer], case: Case) -> MaterialModes:
    """How the tissues of a body may differ from homogeneous ones with their Poisson's ratios, those sought last.

    The layers of a tissue have its Poisson's ratio.
    """
    meshed = [i for i, tissue in enumerate(mesh.tissues) if tissue.meshed]
    of_layers = [(n, layer.tissue) for n, layer in enumerate(layers, start=len(mesh.tissues))]
    sought = [i for i in meshed if case.estimate.seeks_poisson_ratios and mesh.tissues[i].role is Role.ESTIMATE]
    given = [i for i in meshed if case.discrepancy.poisson_sd and i not in sought]
    return material_modes(
        mesh,
        [i for i in meshed if case.discrepancy.heterogeneity_sd or mesh.tissues[i].field],
        length_mm=case.discrepancy.heterogeneity_length_mm,
        poisson=[(i, *(n for n, tissue in of_layers if tissue == i)) for i in (*given, *sought)],
    )


def _finite_strain(
    models: tuple[LinearModel, ...], strained: Sequence[NDArray[np.float64] | None], case: Case
) -> Sequence[FiniteStrainModel | None]:
    """The same bodies under the case's law, each `strained` in its reference; None where that is the linear one."""
    law = case.mechanics.material_law
    if not law.finite:
        return [None] * len(models)
    dilatation = choose_element(case.mechanics.element).dilatation
    settings = NewtonSettings(tolerance=ACCURACY, solver=case.mechanics.solver)
    found: list[FiniteStrainModel] = []
    for model, of_reference in zip(models, strained, strict=True):
        space, conditions = model.space, model.conditions
        like = next((other for other in found if other.space is space), None)
        if like:
            found.append(like.with_conditions(conditions))
            continue
        loads, material = conditions.loads, model.material
        found.append(
            finite_strain_model(
                space,
                conditions.constraint,
                law,
                dilatation=dilatation,
                loads=loads,
                material=material,
                settings=settings,
                strained=of_reference,
            )
        )
    return found
