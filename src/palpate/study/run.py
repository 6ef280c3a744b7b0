"""One case from its file to its result: read, mesh, assemble, estimate."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import replace

import numpy as np

from palpate.images.tissue import Role
from palpate.inversion.conclude import Observed, conclude
from palpate.inversion.estimation import Estimation, Remark
from palpate.inversion.gauss_newton import Bounds
from palpate.inversion.grid_position import FittedState
from palpate.inversion.invert import Inversion, InversionSettings, invert
from palpate.inversion.modulus_map import ModulusMap
from palpate.inversion.noise import NoiseLaw
from palpate.study.body import Body, ImagedStates, inverse_problem, make_body
from palpate.study.case import Case
from palpate.study.plausibility import plausibility_warnings, unit_warnings
from palpate.study.provenance import input_digests, software_versions
from palpate.study.read import read_states
from palpate.study.result import CaseResult, MeshResult, Provenance
from palpate.study.simulate import simulate
from palpate.study.summary import mesh_summary

__all__ = ["estimate", "estimate_states", "fitted_states", "inversion_settings", "mesh", "simulate"]

Progress = Callable[[str], None]


def silent(message: str) -> None:
    """A listener that says nothing."""
    del message


def estimate(case: Case, *, progress: Progress = silent, truth: Mapping[str, float] | None = None) -> CaseResult:
    """Estimate the Young's modulus of every `estimate` tissue of a case, from its images or its phantom.

    `truth`: true moduli (kPa) by tissue, to stand beside the estimates of a simulation; a phantom brings its own.
    Raises `PalpateError`s of reading, meshing and solving; an iteration that did not converge is no error but a
    result whose status says so, with no values.
    """
    began = time.perf_counter()
    progress("reading and aligning the images")
    states = read_states(case)
    truth = _truth(states) if case.phantom else truth
    seconds = time.perf_counter() - began
    result = estimate_states(states, case, progress=progress, truth=truth, read_seconds=seconds)
    provenance = replace(result.provenance, inputs=input_digests(case))
    return replace(result, provenance=provenance)


def estimate_states(
    states: ImagedStates,
    case: Case,
    *,
    progress: Progress = silent,
    truth: Mapping[str, float] | None = None,
    read_seconds: float = 0.0,
) -> CaseResult:
    """The same from states that are already read and aligned; the case gives the settings.

    `truth`: true moduli (kPa) by tissue, to stand beside the estimates of a simulation.
    """
    clock = [time.perf_counter()]
    body = make_body(states, case, progress=progress)
    clock.append(time.perf_counter())
    problem = inverse_problem(body, case, progress=progress)
    clock.append(time.perf_counter())
    settings = inversion_settings(case, problem.modulus_map)
    inversion = invert(problem, settings, progress=progress)
    progress("intervals: residuals' correlation, grid position, driver")
    observed = Observed(body.space, fitted_states(inversion, body), tuple(image.index for image in states.after))
    estimation = conclude(inversion, settings, observed, truth=truth or {}, seed=case.seed)
    clock.append(time.perf_counter())
    stages = np.diff(clock)
    seconds = {"read": read_seconds, "mesh": stages[0], "assemble": stages[1], "estimate": stages[2]}
    seconds["total"] = sum(seconds.values())
    return CaseResult(
        case,
        estimation,
        body.space,
        mesh_summary(body),
        states.before,
        states.after,
        Provenance({key: round(float(value), 3) for key, value in seconds.items()}, {}, software_versions()),
        (*_remarks(states, case), *plausibility_warnings(_values(estimation))),
    )


def mesh(case: Case, *, progress: Progress = silent) -> MeshResult:
    """Mesh the reference state of a case and pass it through the gate."""
    began = time.perf_counter()
    progress("reading and aligning the images")
    states = read_states(case)
    body = make_body(states, case, progress=progress)
    seconds = {"total": round(time.perf_counter() - began, 3)}
    provenance = Provenance(seconds, input_digests(case), software_versions())
    return MeshResult(case, body.space, mesh_summary(body), states.before, provenance, _remarks(states, case))


def inversion_settings(case: Case, mapping: ModulusMap) -> InversionSettings:
    """Starts and bounds as theta; those in kPa are divided by the scale's modulus."""
    scale = mapping.scale_kpa
    options = case.estimate
    starts = np.array(options.starts_kpa) / scale if options.starts_kpa else np.array(options.start_ratios)
    bounds = np.array(options.bounds_kpa) / scale if options.bounds_kpa else np.array(options.bounds_ratio)
    n = len(mapping.tissues)
    law = None
    if case.noise.surface_sd_mm is not None:
        length = case.noise.correlation_length_mm or 6.0
        law = NoiseLaw(np.array([2.0 * case.noise.surface_sd_mm**2]), np.array([length]))
    limits = Bounds(np.full(n, np.log(bounds[0])), np.full(n, np.log(bounds[1])))
    return InversionSettings(tuple(np.full(n, np.log(start)) for start in starts), limits, options.method, law)


def fitted_states(inversion: Inversion, body: Body) -> tuple[FittedState, ...]:
    """Displacements of the whole mesh at the estimate, with the grids that they were seen on."""
    objective, unknowns = inversion.objective, inversion.minimum.unknowns
    moduli = objective.modulus_map.moduli(unknowns[: objective.n_parameters])
    fitted = []
    for surrogate, q, image in zip(
        inversion.surrogates, objective.coefficients(unknowns), body.states.after, strict=True
    ):
        displacement = surrogate.reduced.solve(moduli, q).displacement
        fitted.append(FittedState(displacement, body.states.before.grid, image.grid, body.smoothing_mm))
    return tuple(fitted)


def _truth(states: ImagedStates) -> Mapping[str, float]:
    """True moduli (kPa) where a phantom or a simulation states them on its `estimate` tissues."""
    return {
        tissue.name: tissue.youngs_modulus_kpa
        for tissue in states.before.tissues
        if tissue.role is Role.ESTIMATE and tissue.youngs_modulus_kpa is not None
    }


def _values(estimation: Estimation) -> dict[str, float]:
    return {e.tissue: e.value for e in estimation.estimates if e.value is not None}


def _remarks(states: ImagedStates, case: Case) -> tuple[Remark, ...]:
    return (*unit_warnings(case), *(Remark(finding.code, finding.message) for finding in states.findings))
