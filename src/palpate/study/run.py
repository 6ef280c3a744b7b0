"""One case from its file to its result: read, mesh, assemble, estimate."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import islice

import numpy as np

from palpate.body.body import Body, cost_of_bodies, joint_problem, make_body
from palpate.body.cost import ExpectedCost, expected_cost, refuse_lack
from palpate.body.imaged import ImagedStates
from palpate.body.loads import load_warnings
from palpate.body.poisson_ratios import with_ratios
from palpate.body.provenance import image_names, input_digests, software_versions
from palpate.body.read import read_case_images, read_states
from palpate.body.refusals import linear_strain_warnings
from palpate.case.case import Case, Mechanics
from palpate.case.sources import LAW_NAMES
from palpate.errors import EstimationError
from palpate.findings import Finding, of_pair
from palpate.images.tissue import Role
from palpate.inversion import Bounds, Inversion, InversionSettings
from palpate.mechanics.dilatation import choose_element
from palpate.mechanics.laws.registry import law_named
from palpate.parallel import blas_on_one_thread
from palpate.progress import Forecast, Line, Progress, counted, during, silent
from palpate.statement.conclusion import Observed, conclude
from palpate.statement.estimation import Estimation
from palpate.statement.known_images import Added, KnownImages, why_together
from palpate.statement.plausibility import estimate_warnings, unit_warnings
from palpate.statement.result import CaseResult, MeshResult, MeshSummary, PairResult, Provenance
from palpate.statement.stated_posterior import StatedPosterior
from palpate.statement.variations import Variation, voxel_mm, what_would_change
from palpate.study.case_inversion import invert_case
from palpate.uncertainty import FittedState
from palpate.unknowns import ParameterMap

FURTHER = 13  # starts beside those of the case; a prime


def estimate(
    case: Case,
    *,
    progress: Progress = silent,
    truth: Mapping[str, float] | None = None,
    added: Added | None = None,
) -> CaseResult:
    """Estimate the Young's modulus of every `estimate` tissue of a case, from its images or its phantom.

    `truth`: true moduli (kPa) by tissue, to stand beside the estimates of a simulation; a phantom brings its own;
    `added`: to which earlier estimate the case's later images are added.
    Raises `ResourceError` where this machine has not the memory, `PalpateError`s of reading, meshing and solving; an
    iteration that did not converge is no error but a result whose status says so, with no values.
    """
    began = time.perf_counter()
    reading = during("read", progress)
    reading("reading and aligning the images")
    images = read_case_images(case, progress=reading)
    progress(Line(_in_words(images.pairs), "read"))
    if added is not None:
        added.built_on.refuse_other_images(images.inputs)
    first = images.pairs[0]
    cost = expected_cost(case, first.before, first.after, n_pairs=len(images.pairs), mesh=first.mesh)
    refuse_lack(cost)
    progress(_forecast(cost))
    if case.phantom:
        stated = [(t.name, t.youngs_modulus_kpa) for t in first.before.tissues if t.role is Role.ESTIMATE]
        truth = {name: value for name, value in stated if value is not None}
    seconds = time.perf_counter() - began
    result = estimate_states(images.pairs, case, progress=progress, truth=truth, read_seconds=seconds, added=added)
    return replace(result, provenance=replace(result.provenance, inputs=images.inputs))


@blas_on_one_thread()
def estimate_states(
    pairs: Sequence[ImagedStates],
    case: Case,
    *,
    progress: Progress = silent,
    truth: Mapping[str, float] | None = None,
    read_seconds: float = 0.0,
    added: Added | None = None,
) -> CaseResult:
    """The same from states that are already read and aligned; the case gives the settings.

    pairs: of the same body, each with its own reference state, which are meshed on their own and share the moduli;
    truth: true moduli (kPa) by tissue, to stand beside the estimates of a simulation; added: as above.
    """
    clock, mesh = [time.perf_counter()], added.mesh if added else None
    bodies = tuple(make_body(pair, case, progress=during("mesh", progress), mesh=mesh) for pair in pairs)
    earlier = added.built_on.images if added else 0
    cost = cost_of_bodies(bodies, case)
    refuse_lack(cost)
    progress(_forecast(cost))
    clock.append(time.perf_counter())
    progress(Line(f"the equations of {counted(cost.unknowns, 'unknown')}", "assemble"))
    problem = joint_problem(bodies, case, progress=during("assemble", progress), earlier=earlier)
    settings = inversion_settings(case, problem.parameters)
    if added:
        problem, settings = added.known.problem_with(problem, case), added.settings(settings)
    clock.append(time.perf_counter())
    later = "later image" if len(problem.states) == 1 else "later images"
    progress(Line(f"the moduli that explain the {later}, from {counted(len(settings.every_start), 'start')}", "search"))
    inversion = invert_case(bodies, problem, case, settings, progress=progress)
    best = inversion.objective.parameters.in_words(inversion.minimum.unknowns)
    progress(Line(f"best fit: {best}; how far can it be off?", "intervals"))
    stating = during("intervals", progress)

    def vary(posterior: StatedPosterior) -> tuple[Variation, ...]:
        """What would change the answer; with added images what the earlier ones would tell then is not known."""
        if added:
            return ()
        stating("what would change the answer: surfaces, constants, frame and law, one after the other")
        return _what_would_change(inversion, settings, case, bodies, posterior)

    estimation = conclude(
        inversion,
        settings,
        observed_of(inversion, bodies),
        truth=truth or {},
        seed=case.seed,
        samples=case.estimate.samples,
        vary=vary,
        progress=stating,
    )
    known, n_images = None, earlier + len(problem.states)
    if estimation.images and not why_together(case, n_images):
        known = KnownImages.of(replace(estimation.images, n_images=n_images), problem, case)
    clock.append(time.perf_counter())
    stages = np.diff(clock)
    seconds = {"read": read_seconds, "mesh": stages[0], "assemble": stages[1], "estimate": stages[2]}
    seconds["total"] = sum(seconds.values())
    return CaseResult(
        case,
        estimation,
        tuple(_pair_result(body, estimation) for body in bodies),
        Provenance({key: round(float(value), 3) for key, value in seconds.items()}, {}, software_versions()),
        (
            *_remarks(case, *bodies),
            *strain_warnings(case, bodies, estimation),
            *estimate_warnings(case, estimation),
        ),
        note=added.built_on.sentence(len(problem.states)) if added else "",
        known=known,
        built_on=added.built_on if added else None,
    )


def make_mesh(case: Case, *, progress: Progress = silent) -> MeshResult:
    """The tetrahedra of a case's reference image, as `palpate.make_mesh` gives them; raises as that does."""
    began = time.perf_counter()
    progress(Line("reading the images"))
    states = read_states(case, progress=progress)
    inputs = input_digests(case, states.inputs)
    body = make_body(states, case, progress=progress)
    seconds = {"total": round(time.perf_counter() - began, 3)}
    provenance = Provenance(seconds, inputs, software_versions())
    return MeshResult(case, body.space, _summary(body), states.before, provenance, _remarks(case, body))


def _what_would_change(
    inversion: Inversion,
    settings: InversionSettings,
    case: Case,
    bodies: tuple[Body, ...],
    posterior: StatedPosterior,
) -> tuple[Variation, ...]:
    """What would change the estimate of a case; nothing where the estimate itself cannot be followed.

    A finite-strain law is compared with other finite-strain laws, the linear law with the default one. A step from
    finite strain cannot reach the linear law, nor a law under which the reference state would differ, too.
    """
    mechanics, later = case.mechanics, [image for body in bodies for image in body.states.after]
    finite = [name for name in LAW_NAMES if law_named(name).finite and name != mechanics.law]
    others = [law_named(name) for name in (finite if mechanics.material_law.finite else (Mechanics().law,))]
    try:
        return what_would_change(
            inversion,
            settings,
            bodies[0].layered.mesh.tissues,
            [] if case.strained_reference else others,
            dilatation=choose_element(mechanics.element).dilatation,
            voxel_mm=voxel_mm(later),
            posterior=posterior,
        )
    except EstimationError:
        return ()


def _forecast(cost: ExpectedCost) -> Forecast:
    return Forecast(cost.sentence, cost.stages)


def _in_words(pairs: Sequence[ImagedStates]) -> str:
    """What was read of a case."""
    tissues = counted(len(pairs[0].before.tissues), "tissue")
    if pairs[0].mesh is not None:
        return f"a mesh with {tissues}"
    return f"{counted(sum(1 + len(pair.after) for pair in pairs), 'image')} with {tissues}"


def inversion_settings(case: Case, parameters: ParameterMap) -> InversionSettings:
    """Starts and bounds as theta; those in kPa are divided by the scale's modulus.

    The case's starts, on the diagonal of all moduli, then a lattice over the bounds: with N further ones the shares
    ((k 2^j mod N) + 1/2) / N of modulus j (Korobov 1959), which fill the box evenly.
    """
    scale = parameters.scale_kpa
    options = case.estimate
    starts = np.array(options.starts_kpa) / scale if options.starts_kpa else np.array(options.start_ratios)
    bounds = np.array(options.bounds_kpa) / scale if options.bounds_kpa else np.array(options.bounds_ratio)
    n = len(parameters.tissues)
    low, high = (np.full(n, np.log(end)) for end in bounds)
    begin = tuple(np.full(n, np.log(start)) for start in starts)
    steps = np.array([pow(2, j, FURTHER) for j in range(n)])
    shares = (np.arange(FURTHER)[:, None] * steps % FURTHER + 0.5) / FURTHER
    further = tuple(low + share * (high - low) for share in shares)
    return InversionSettings(begin, Bounds(low, high), further)


def observed_of(inversion: Inversion, bodies: Sequence[Body]) -> Observed:
    """The fitted states of bodies, with the images that they are held against."""
    images = tuple(of.image.index if of.image else None for body in bodies for of in body.states.later)
    return Observed(fitted_states(inversion, *bodies), images)


def fitted_states(inversion: Inversion, *bodies: Body) -> tuple[FittedState, ...]:
    """Displacements of the whole meshes at the estimate, with the grids that they were seen on, body after body."""
    objective, unknowns = inversion.objective, inversion.minimum.unknowns
    moduli, coefficients = objective.parameters.moduli(unknowns), objective.parameters.coefficients(unknowns)
    images = [(body, of.image or body.states.before) for body in bodies for of in body.states.later]
    return tuple(
        FittedState(body.space, state.displacement(moduli, q), body.states.before.grid, image.grid)
        for state, q, (body, image) in zip(objective.states, coefficients, images, strict=True)
    )


def _summary(body: Body) -> MeshSummary:
    return MeshSummary.of(body.quality, body.space, body.edge_length)


def _pair_result(body: Body, estimation: Estimation) -> PairResult:
    """A body as the result has it, with the Poisson's ratios that were found."""
    states = body.states
    return PairResult(with_ratios(body.space, estimation.found_ratios), _summary(body), states.before, states.later)


def strain_warnings(case: Case, bodies: Sequence[Body], estimation: Estimation) -> tuple[Finding, ...]:
    """What `linear_strain_warnings` says of the fitted displacements, those of the first body's images first."""
    left = iter(estimation.displacements)
    moved = [(body.space, list(islice(left, len(body.states.later)))) for body in bodies]
    return linear_strain_warnings(case.mechanics.material_law, *moved, images=image_names(case))


def _remarks(case: Case, *bodies: Body) -> tuple[Finding, ...]:
    pairs = enumerate(((*body.states.findings, *body.findings) for body in bodies), start=1)
    of_images = (finding for n, findings in pairs for finding in of_pair(findings, n))
    return (*unit_warnings(case), *load_warnings(case), *of_images)
