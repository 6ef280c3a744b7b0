"""How much of an estimate is assumption: the case estimated once, then again under other constants, laws and meshes.

What a change of the residuals shows is found on the fast path; a change of the model's geometry, law or boundary is
estimated anew from the estimate on. Each finished part is kept, so that an interrupted study goes on where it ended.
"""

from __future__ import annotations

import hashlib
import json
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import asdict, dataclass, replace
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from palpate.body.body import Body, joint_problem, make_body
from palpate.body.edge_length import edge_length_of
from palpate.body.provenance import software_versions
from palpate.body.read import CaseImages, read_case_images
from palpate.case.case import Case
from palpate.case.file import case_tables
from palpate.case.sources import LAW_NAMES
from palpate.errors import (
    ConfigurationError,
    EstimationError,
    GeometryError,
    InputDataError,
    NotConverged,
    PalpateError,
    ResourceError,
)
from palpate.images.tissue import Role
from palpate.inversion import Inversion, InversionSettings, StopRule
from palpate.mechanics.dilatation import choose_element
from palpate.parallel import blas_on_one_thread
from palpate.progress import Line, Progress, details, silent
from palpate.statement.conclusion import conclude
from palpate.statement.result import Provenance, closing, json_object
from palpate.statement.variations import Variation, fast_variations, voxel_mm
from palpate.study.case_inversion import invert_case
from palpate.study.outputs import OutputFolder, make_folder, read_json, write_json
from palpate.study.run import inversion_settings, observed_of

KEPT = "variants"  # folder of the finished parts
COARSER = 1.25  # times the mesh's edge length
VARIED = StopRule(step_sd=0.1)  # of a variant's standard deviation: smaller changes are not significant
BASE = ("tissue", "unit", "value", "interval95", "relative_to", "ratio", "ratio_interval95", "verdict", "why")

Bodies = tuple[Body, ...]


@dataclass(frozen=True, slots=True)
class Kept:
    """Where finished parts of a study are kept: in a folder that this process holds, or nowhere (None)."""

    outputs: OutputFolder | None = None

    def get(self, name: str, key: str) -> dict[str, Any] | None:
        """The part of that name, if it is of the same case, inputs and version (`key`)."""
        if self.outputs is None:
            return None
        try:
            document = read_json(self.outputs.path / KEPT / f"{name}-{key[:16]}.json")
        except InputDataError:
            return None
        return document if document.get("key") == key else None

    def put(self, name: str, key: str, part: Mapping[str, Any]) -> None:
        """Keep a part, whole or not at all; raises `ResourceError` where the disk refuses."""
        if self.outputs is None:
            return
        with self.outputs.new_files() as area:
            make_folder(area / KEPT)
            write_json(area / KEPT / f"{name}-{key[:16]}.json", json_object(part) | {"key": key})


@dataclass(frozen=True, slots=True)
class Sensitivity:
    """Every modulus under every changed assumption.

    estimates: of the case as it is, an entry a tissue as in result.json.
    """

    case: Case
    estimates: tuple[Mapping[str, Any], ...]
    variations: tuple[Variation, ...]
    provenance: Provenance

    def to_dict(self) -> dict[str, Any]:
        """The document sensitivity.json, schema palpate.sensitivity/1, ready for strict JSON."""
        document = {
            "schema": "palpate.sensitivity/1",
            "id": self.case.id,
            "law": self.case.mechanics.law,
            "element": self.case.mechanics.element,
            "estimates": [dict(item) for item in self.estimates],
            "variations": [asdict(variation) for variation in self.variations],
        }
        return json_object(document | closing(self.case, self.provenance, ()))


@dataclass(frozen=True, slots=True)
class Variant:
    """A case that is estimated anew: `name` of its file; makes: what differs, "model", "mesh" or "images"."""

    name: str
    cause: str
    setting: str
    case: Case
    makes: str = "model"


@blas_on_one_thread()
def sensitivity(case: Case, *, kept: Kept | None = None, progress: Progress = silent) -> Sensitivity:
    """Estimate a case, and say how each modulus depends on what it rests on.

    kept: finished parts of an earlier study are taken from there, new ones left there. A variant without an estimate
    says why. Raises as `estimate` does, `ConfigurationError` for a case that seeks Poisson's ratios, which are varied
    here, `NotConverged` where the case itself has no estimate.
    """
    began, kept = time.perf_counter(), kept or Kept()
    if case.estimate.seeks_poisson_ratios:
        raise ConfigurationError(
            "a sensitivity study varies Poisson's ratios, but this case estimates them:"
            ' leave [estimate] parameters at ["youngs_modulus"]'
        )
    progress(Line("reading the images"))
    images = read_case_images(case, progress=progress)
    key = kept_under(case, images.inputs)
    bodies = cache(lambda: _meshed(images, case, details(progress)))
    base = kept.get("estimate", key)
    if base is None:
        base = json_object(_estimated(case, bodies(), progress))
        kept.put("estimate", key, base)
    variations = [Variation(**each) for each in base["variations"]]
    first = images.pairs[0]
    edge_mm = edge_length_of(case, first.before, first.after).mm
    variants = [Variant("as-it-is", "", "", case), *variants_of(case, edge_mm)]
    varied = list[Variation]()
    for number, variant in enumerate(variants):
        part = kept.get(variant.name, key)
        if part is None:
            what = f"{variant.cause.replace('_', ' ')} {variant.setting}"
            of = f"estimate {number} of {len(variants) - 1} under another assumption: {what}"
            progress(Line(of if number else "the case as it is, estimated again from where it ended"))
            found = _varied(variant, images, bodies, base, details(progress))
            part = json_object(asdict(found))
            kept.put(variant.name, key, part)
        varied.append(Variation(**{name: value for name, value in part.items() if name != "key"}))
    variations += _against(*varied)
    seconds = {"total": round(time.perf_counter() - began, 3)}
    return Sensitivity(
        case,
        tuple(base["estimates"]),
        tuple(variations),
        Provenance(seconds, images.inputs, software_versions()),
    )


def _against(again: Variation, *varied: Variation) -> list[Variation]:
    """Variations estimated anew, against the case that was estimated anew likewise.

    The way to an estimate moves it by up to a tenth of a standard deviation; what assumes nothing else shows no change.
    """
    way = again.changes or {}
    return [
        each
        if each.changes is None
        else replace(each, changes={name: change - way.get(name, 0.0) for name, change in each.changes.items()})
        for each in varied
    ]


def _meshed(images: CaseImages, case: Case, progress: Progress) -> Bodies:
    return tuple(make_body(pair, case, progress=progress) for pair in images.pairs)


def kept_under(case: Case, inputs: Mapping[str, str]) -> str:
    """What a finished part is of: the case without the places of its files, their contents, this version."""
    parts = [case_tables(case, lambda path: path.name), dict(inputs), software_versions().get("palpate")]
    return hashlib.sha256(json.dumps(parts, sort_keys=True, default=str).encode()).hexdigest()


def _inverted(
    bodies: Bodies, case: Case, progress: Progress, start: NDArray[np.float64] | None = None
) -> tuple[Inversion, InversionSettings]:
    """The inversion of a case from its own starts, or from one alone to a tenth of its standard deviations."""
    problem = joint_problem(bodies, case, progress=progress)
    settings = inversion_settings(case, problem.parameters)
    if start is not None:
        inside = np.clip(start, settings.bounds.lower, settings.bounds.upper)
        settings = replace(settings, starts=(inside,), further=())
        return invert_case(bodies, problem, case, settings, progress=progress, rule=VARIED), settings
    return invert_case(bodies, problem, case, settings, progress=progress), settings


def _estimated(case: Case, bodies: Bodies, progress: Progress) -> dict[str, Any]:
    """The case as it is, and all that is found on the fast path around it."""
    progress(Line("estimating the case as it is"))
    inversion, settings = _inverted(bodies, case, details(progress))
    if not inversion.minimum.converged:
        raise NotConverged(
            f"the case itself has no estimate ({inversion.minimum.outcome.value}), so its sensitivities are unknown;"
            " see the warnings of `palpate estimate`"
        )
    later = tuple(image for body in bodies for image in body.states.after)
    observed = observed_of(inversion, bodies)
    estimation = conclude(inversion, settings, observed, truth={}, seed=case.seed, progress=details(progress))
    tissues, dilatation = bodies[0].space.mesh.tissues, choose_element(case.mechanics.element).dilatation
    progress(Line("changing constants, surfaces, modes and priors, one after the other"))
    variations = fast_variations(inversion, settings, tissues, dilatation=dilatation, voxel_mm=voxel_mm(later))
    return {
        "estimates": [{name: getattr(item, name) for name in BASE} for item in estimation.estimates],
        "theta": inversion.minimum.unknowns[: inversion.objective.n_parameters],
        "variations": [asdict(variation) for variation in variations],
    }


def variants_of(case: Case, edge_mm: float) -> Iterator[Variant]:
    """What is estimated anew, what costs least first; edge_mm: the edge length of the case as it is."""
    law, domain = case.mechanics, case.domain
    laws = sorted((name for name in LAW_NAMES if name != law.law), key=lambda name: name != "linear")
    boundaries = [name for name in ("sliding", "free", "fixed") if name != domain.outer_boundary]
    coarser_mm = COARSER * edge_mm

    def of_law(name: str) -> Variant:
        """Under another law."""
        return Variant(f"law-{name}", "law", name, replace(case, mechanics=replace(law, law=name)))

    yield from (of_law(name) for name in laws if name == "linear")
    coarser = replace(case, mesh=replace(case.mesh, edge_length_mm=coarser_mm))
    yield Variant("edge-length", "edge_length", f"{coarser_mm:g} mm", coarser, "mesh")
    for name in boundaries:
        other = replace(case, domain=replace(domain, outer_boundary=name))
        yield Variant(f"outer-boundary-{name}", "outer_boundary", name, other)
    yield from (of_law(name) for name in laws if name != "linear")
    rigid = any(tissue.role is Role.RIGID for tissue in case.tissues)
    if case.images is not None and (rigid or case.align != "none"):
        method = "none" if case.align != "none" else "rigid-tissues"
        unaligned = replace(case, images=replace(case.images, align=method))
        yield Variant(f"alignment-{method}", "alignment", method, unaligned, "images")


def _varied(
    variant: Variant, images: CaseImages, bodies: Callable[[], Bodies], base: Mapping[str, Any], progress: Progress
) -> Variation:
    """One variant estimated anew; one that has no estimate says why."""
    began, case, changes, reason = time.perf_counter(), variant.case, None, ""
    at_bound: tuple[str, ...] = ()
    theta, names = np.array(base["theta"]), [item["tissue"] for item in base["estimates"]]
    try:
        if variant.makes == "model":
            made = bodies()
        else:
            own = read_case_images(case, progress=progress) if variant.makes == "images" else images
            made = _meshed(own, case, progress)
        edge = made[0].edge_length
        if variant.makes == "mesh" and edge and edge.mm != case.mesh.edge_length_mm:
            raise GeometryError(f"no mesh of {variant.setting} passes its quality check")
        inversion, settings = _inverted(made, case, progress, theta)
        if not inversion.minimum.converged:
            raise EstimationError(f"the estimate did not converge: {inversion.minimum.outcome.value}")
        found = inversion.minimum.unknowns[: len(theta)]
        changes = dict(zip(names, (found - theta).tolist(), strict=True))
        ended = settings.bounds.reached(found)
        at_bound = tuple(name for name, there in zip(names, ended, strict=True) if there)
    except ResourceError:
        raise
    except PalpateError as error:
        reason = str(error)
    seconds = round(time.perf_counter() - began, 3)
    return Variation(variant.cause, "", variant.setting, "re-estimated", changes, at_bound, reason, seconds)
