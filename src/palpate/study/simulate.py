"""The later state of a body whose moduli are given, from the images, a filling or a phantom."""

from __future__ import annotations

import time
from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from palpate.body.body import Body, inverse_problem, make_body, strained_body
from palpate.body.driver_fit import fit_driver
from palpate.body.loads import case_loads
from palpate.body.provenance import input_digests, software_versions
from palpate.body.read import phantom_scene, read_states
from palpate.case.case import Case, Mechanics
from palpate.errors import ConfigurationError
from palpate.findings import Finding
from palpate.images.label_image import LabelImage
from palpate.images.segmentation import Segmentation, first_labels
from palpate.images.tissue import Role, Tissue
from palpate.mechanics.boundary import outer_constraint
from palpate.mechanics.dilatation import choose_element
from palpate.mechanics.equilibrium import equilibrium
from palpate.mechanics.finite_strain import finite_strain_model
from palpate.mechanics.loads import Load
from palpate.mechanics.rest_state import unloaded_displacement
from palpate.mesh.quality import mesh_figures
from palpate.mesh.space import LagrangeSpace
from palpate.mesh.voxelise import voxelise
from palpate.observation.prescribed_motion import prescribed_motion
from palpate.phantoms.motion import wall_filling
from palpate.progress import Line, Progress, silent
from palpate.statement.result import MeshSummary, Provenance, Simulation


def simulate(case: Case, *, steps: int = 1, progress: Progress = silent) -> Simulation:
    """The later states of a case, as `palpate.simulate` gives them; raises as that does."""
    began = time.perf_counter()
    inputs: Mapping[str, str] = {}
    if case.phantom is not None:
        scene = phantom_scene(case)
        space, tissues = scene.space, scene.tissues
        before, after, remarks = scene.before, scene.after, tuple[Finding, ...]()
        summary = MeshSummary.of(mesh_figures(space.mesh), space)
        displacements = tuple(scene.displacement * (step / steps) for step in range(1, steps + 1))
    else:
        progress(Line("reading the images"))
        states = read_states(case, progress=progress)
        inputs = input_digests(case, states.inputs)
        tissues = states.before.tissues
        _refuse_unknown(tissues)
        body = make_body(states, case, progress=progress)
        space, summary = body.space, MeshSummary.of(body.quality, body.space, body.edge_length)
        progress(Line("solving for the displacement"))
        shares = [step / steps for step in range(1, steps + 1)]
        if case.motion is None and states.after:
            problem = inverse_problem(body, case, progress=progress)
            given, model = _moduli(problem.states[0].model.space.mesh.tissues), problem.states[0].finite_strain
            if model is not None and case.strained_reference:
                borne = case_loads(case, space, 0)
                strained = unloaded_displacement(model, given, np.zeros(model.material.n_modes), borne)
                problem = inverse_problem(strained_body(body, strained, case), case, progress=progress)
            displacements = fit_driver(problem, given, shares=shares)[-1]
        elif case.mechanics.material_law.finite:
            displacements = tuple(_moved(body, case, share) for share in shares)
        else:
            whole = _moved(body, case, 1.0)
            displacements = tuple(whole * share for share in shares)
        last = displacements[-1]
        before, after = (_labels(states.before, space, motion) for motion in (np.zeros_like(last), last))
        remarks = (*states.findings, *body.findings)
    moduli = {t.name: t.youngs_modulus_kpa for t in tissues if t.meshed and t.youngs_modulus_kpa is not None}
    seconds = {"total": round(time.perf_counter() - began, 3)}
    provenance = Provenance(seconds, inputs, software_versions())
    return Simulation(case, space, summary, displacements, before, after, moduli, provenance, remarks)


def filled(
    space: LagrangeSpace,
    segmentation: Segmentation,
    *,
    filling_mm: float,
    outer: str,
    mechanics: Mechanics,
    loads: tuple[Load, ...] = (),
    borne: tuple[Load, ...] = (),
) -> NDArray[np.float64]:
    """Displacement (n_points, 3) mm of a body whose drivers fill by `filling_mm`, whose bones are held.

    segmentation: the labels that the drivers' walls come from; outer: see `outer_constraint`; loads: what is added to
    those that the body bears as it is segmented, `borne`. The tissues of the space's mesh state their
    moduli. Raises `NotConverged` as `equilibrium` does.
    """
    tissues = space.mesh.tissues
    _refuse_unknown(tissues)
    motion = prescribed_motion(space, {}, n_modes=0, kernel_mm=1.0, prior_mm=1.0)
    offset = np.zeros_like(space.points)
    for i, tissue in enumerate(tissues):
        if tissue.role is Role.DRIVER:
            walls = np.unique(space.facets(space.mesh.boundary[space.mesh.beyond == i]))
            offset[walls] = wall_filling(segmentation, i, filling_mm=filling_mm).at(space.points[walls])
    for i, tissue in enumerate(tissues):
        if tissue.role is Role.RIGID:
            offset[np.unique(space.facets(space.mesh.boundary[space.mesh.beyond == i]))] = 0.0
    no_modes = np.zeros((offset.size, 0))
    constraint = outer_constraint(
        space, outer=outer, modes=no_modes, offset=offset.ravel(), prescribed=motion.prescribed
    )
    law, dilatation = mechanics.material_law, choose_element(mechanics.element).dilatation
    strained = None
    if borne and law.finite:
        model = finite_strain_model(space, constraint, law, dilatation=dilatation)
        strained = unloaded_displacement(model, _moduli(tissues), np.zeros(0), borne)
    found = equilibrium(
        space, constraint, _moduli(tissues), law=law, dilatation=dilatation, loads=loads, strained=strained
    )
    return found.displacement


def _moved(body: Body, case: Case, share: float) -> NDArray[np.float64]:
    """Displacement (n_points, 3) mm by a share of the filling and of the loads."""
    return filled(
        body.space,
        body.states.before,
        filling_mm=share * case.motion.filling_mm if case.motion else 0.0,
        outer=case.domain.outer_boundary,
        mechanics=case.mechanics,
        loads=case_loads(case, body.space, 1, share=share),
        borne=case_loads(case, body.space, 0),
    )


def _moduli(tissues: tuple[Tissue, ...]) -> NDArray[np.float64]:
    """Young's moduli (n_regions,) kPa of the meshed tissues."""
    return np.array([tissue.youngs_modulus_kpa for tissue in tissues if tissue.meshed], dtype=float)


def _refuse_unknown(tissues: tuple[Tissue, ...]) -> None:
    missing = [t.name for t in tissues if t.meshed and t.youngs_modulus_kpa is None]
    if missing:
        raise ConfigurationError(
            f"a simulation needs the youngs_modulus_kpa (kPa) of every meshed tissue; {missing} lack it"
        )


def _labels(segmentation: Segmentation, space: LagrangeSpace, displacement: NDArray[np.float64]) -> LabelImage:
    """Label image of the deformed mesh on the segmentation's grid, with the smallest label of each tissue.

    The mesh does not know where one hollow tissue ends and another begins, as air on bone: there the labels stay.
    """
    tissues = space.mesh.tissues
    table = first_labels(tissues)
    names = {int(label): tissue.name for label, tissue in zip(table, tissues, strict=True)}
    index = voxelise(space, displacement, segmentation.grid)
    hollow = np.array([not tissue.meshed for tissue in tissues])
    index = np.where(hollow[index] & hollow[segmentation.index], segmentation.index, index)
    return LabelImage(table[index], segmentation.grid, names)
