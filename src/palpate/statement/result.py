"""What comes out of a case: results as values, and their JSON documents."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from palpate.body.edge_length import EdgeLength
from palpate.body.imaged import LaterImage
from palpate.body.poisson_ratios import NOT_IDENTIFIED, PoissonRatioEstimate, no_ratio
from palpate.body.provenance import image_names
from palpate.case.case import Case
from palpate.case.file import case_tables
from palpate.case.tissue import CaseTissue
from palpate.errors import NotConverged, PalpateError
from palpate.findings import Finding, one_a_cause, warning_rows
from palpate.images.label_image import LabelImage
from palpate.images.segmentation import Segmentation
from palpate.images.tissue import Role, Tissue
from palpate.mesh.quality import MeshQuality
from palpate.mesh.space import LagrangeSpace
from palpate.progress import counted, grouped
from palpate.statement.discrepancy import FoundDiscrepancy
from palpate.statement.estimation import Estimation, ModulusEstimate, StatedExplanation, no_estimate
from palpate.statement.known_images import BuiltOn, KnownImages
from palpate.statement.map_summary import map_summary
from palpate.uncertainty import StiffnessMap

SCHEMA = "palpate.result/1"


@dataclass(frozen=True, slots=True)
class MeshSummary:
    """Size and quality of a mesh; angles in degrees; volume_error: tissue -> (mesh - image) / image, dimensionless.

    edge_length_mm: that at the organs, which may be shorter than the case's (finding "finer-mesh"), and the reason for
    it; None where the mesh is a phantom's own.
    """

    nodes: int
    tets: int
    dofs: int
    min_dihedral_deg: float
    p5_dihedral_deg: float
    volume_error: Mapping[str, float]
    edge_length_mm: float | None = None
    edge_length_reason: str = ""

    @classmethod
    def of(cls, quality: MeshQuality, space: LagrangeSpace, edge: EdgeLength | None = None) -> MeshSummary:
        """Of a mesh with these figures, and the space on it."""
        angles = quality.min_dihedral_deg, quality.p5_dihedral_deg
        stated = (edge.mm, edge.in_words) if edge else (None, "")
        return cls(quality.nodes, quality.tets, 3 * len(space.points), *angles, quality.volume_error, *stated)


@dataclass(frozen=True, slots=True)
class Provenance:
    """Seconds of each stage, SHA-256 of each input by its key, versions of the software."""

    seconds: Mapping[str, float] = field(default_factory=dict)
    inputs: Mapping[str, str] = field(default_factory=dict)
    versions: Mapping[str, str] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class PairResult:
    """A reference state with its later states: its mesh and its images.

    space: the displacements' points on the mesh; before: segmentation; later: its later states, their images brought to
    the first, all in RAS mm.
    """

    space: LagrangeSpace
    mesh_summary: MeshSummary
    before: Segmentation
    later: tuple[LaterImage, ...]

    @property
    def after(self) -> tuple[Segmentation, ...]:
        """The later images that there are."""
        return tuple(of.image for of in self.later if of.image is not None)


@dataclass(frozen=True, slots=True)
class CaseResult:
    """The whole outcome of one estimate.

    pairs: each reference state with its later states; the estimation has theirs one after the other;
    remarks: those of the study, beside the estimation's own;
    note: a sentence that must stand wherever the numbers are shown (of what a demo simulates, say);
    known: what its images tell, for others that are added, None where none may be; built_on: the estimate that they
    were added to, the case is then that of the added images.
    """

    case: Case
    estimation: Estimation
    pairs: tuple[PairResult, ...]
    provenance: Provenance
    remarks: tuple[Finding, ...] = ()
    note: str = ""
    known: KnownImages | None = None
    built_on: BuiltOn | None = None

    @property
    def whole_case(self) -> Case:
        """The case with all later images, those that were seen before among them."""
        return self.built_on.case if self.built_on else self.case

    @property
    def tissues(self) -> tuple[Tissue, ...]:
        """The case's tissues with their labels, in the mesh's order."""
        return self.space.mesh.tissues

    @property
    def space(self) -> LagrangeSpace:
        """The points of displacements on the mesh of the first reference state."""
        return self.pairs[0].space

    @property
    def mesh_summary(self) -> MeshSummary:
        """Size and quality of that mesh."""
        return self.pairs[0].mesh_summary

    @property
    def before(self) -> Segmentation:
        """The first reference image."""
        return self.pairs[0].before

    @property
    def after(self) -> tuple[Segmentation, ...]:
        """Its later images, brought to it."""
        return self.pairs[0].after

    @property
    def displacements(self) -> tuple[NDArray[np.float64], ...]:
        """Displacements (n_points, 3) mm of the first reference state, one for each later state."""
        return self.displacements_of(0)

    def displacements_of(self, pair: int) -> tuple[NDArray[np.float64], ...]:
        """Those of a pair, by its number from 0: (n_points, 3) mm a later state, none where nothing was found."""
        first = sum(len(before.later) for before in self.pairs[:pair])
        return self.estimation.displacements[first : first + len(self.pairs[pair].later)]

    @property
    def all_remarks(self) -> tuple[Finding, ...]:
        """Warnings of the study and of the estimation, one for each cause, the most harmful first."""
        return one_a_cause((*self.remarks, *self.estimation.remarks))

    @property
    def unit(self) -> str:
        """Unit of `stiffness`: "kPa", or "ratio" when neither a modulus nor a load is known."""
        return _unit(self.case, self.tissues)

    @property
    def stiffness(self) -> NDArray[np.float64]:
        """Young's modulus of each tissue in `unit`, (n_tissues,); NaN where none was found or the tissue is hollow."""
        usable = self.estimation.estimates if self.estimation.status == "converged" else ()
        found = {e.tissue: e.value if self.unit == "kPa" else e.ratio for e in usable}
        values = [t.youngs_modulus_kpa if t.role is Role.KNOWN else found.get(t.name) for t in self.tissues]
        meshed = [v if t.meshed else None for t, v in zip(self.tissues, values, strict=True)]
        return np.array([math.nan if value is None else value for value in meshed])

    def stiffness_map(self, pair: int = 0) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
        """Young's modulus in `unit`, standard deviation of ln E, and its resolution, (n_tets,) each, of a pair's mesh.

        Of tissues that are not mapped those of the tissue, NaN and NaN.
        """
        mesh = self.pairs[pair].space.mesh
        first = sum(len(before.later) for before in self.pairs[:pair])
        stiffness, sd = self.stiffness[mesh.region], np.full(len(mesh.region), np.nan)
        resolution = sd.copy()
        for of in self.estimation.maps:
            if first <= of.state < first + len(self.pairs[pair].later):
                stiffness[of.elements] *= np.exp(of.log_ratio)
                sd[of.elements], resolution[of.elements] = of.sd, of.resolution
        return stiffness, sd, resolution

    def to_dict(self) -> dict[str, Any]:
        """The document `result.json`, schema palpate.result/1, ready for strict JSON."""
        estimation, names = self.estimation, image_names(self.case)
        known, pairs = estimation.information, estimation.image_pairs
        each = zip(names, pairs.alone if pairs else (), strict=False)
        alone = [{"after": name} | _plain(pair) for name, pair in each]
        drawn = estimation.samples if estimation.status == "converged" else None
        provenance = self.provenance
        if self.built_on:
            provenance = replace(provenance, inputs=self.built_on.every_input(provenance.inputs))
        document = _heading(self.case, estimation.status, estimation.reason) | {
            "estimates": [
                *(_estimate(item, estimation.status) for item in estimation.estimates),
                *(_ratio(item, estimation.status) for item in estimation.poisson_ratios),
            ],
            "correlation": estimation.correlation.tolist(),
            "information": known and _plain(known),
            "information_shares": {tissue: dict(of) for tissue, of in estimation.information_shares.items()},
            "variations": [_plain(variation) for variation in estimation.variations],
            "maps": [_map(of, names) for of in estimation.maps],
            "combinations": [_plain(pair) for pair in estimation.combinations],
            "regions": [_plain(region) for region in estimation.regions],
            "image_pairs": pairs and _plain(pairs) | {"alone": alone},
            "built_on": self.built_on and self.built_on.to_dict(),
            "explanations": [
                _explanation(of, names) for of in (estimation.explanations if estimation.status == "converged" else ())
            ],
            "samples": drawn and drawn.to_dict(),
            "alignment": [
                later.alignment.row(name)
                for name, later in zip(names, (later for pair in self.pairs for later in pair.later), strict=False)
                if later.alignment is not None
            ],
            "fit": [
                {"after": name}
                | {
                    fit.tissue: {
                        "start": _plain(fit.start),
                        "end": _plain(fit.end),
                        "observed_share": fit.observed_share,
                    }
                    for fit in fits
                }
                for name, fits in zip(names, estimation.fits, strict=False)
            ],
            "forces": [
                {"after": names[force.state], **{k: v for k, v in _plain(force).items() if k != "state"}}
                for force in estimation.forces
            ],
            "starts": [
                {
                    "start": dict(start.start),
                    "end": dict(start.end),
                    "objective_mm2": start.objective_mm2,
                    "status": start.status,
                    "reason": start.reason,
                    "iterations": start.iterations,
                    "minimum": start.minimum,
                    "history_mm2": [step.objective_mm2 for step in start.history],
                }
                for start in estimation.starts
            ],
            "outer_loop": {"history_mm2": [step.objective_mm2 for step in estimation.outer_loop]},
            **_discrepancy(estimation.discrepancy, names),
            "observations": dict(estimation.observations),
            "counts": dict(estimation.counts),
            "mesh": _plain(self.mesh_summary),
        }
        if self.pairs[1:]:
            document |= {"pairs": [{"mesh": _plain(pair.mesh_summary)} for pair in self.pairs[1:]]}
        return json_object(document | closing(self.whole_case, provenance, self.all_remarks) | {"note": self.note})


@dataclass(frozen=True, slots=True)
class MeshResult:
    """A mesh made from the reference image: `before` is its segmentation."""

    case: Case
    space: LagrangeSpace
    mesh_summary: MeshSummary
    before: Segmentation
    provenance: Provenance
    remarks: tuple[Finding, ...] = ()

    def __repr__(self) -> str:
        """One line."""
        found = self.mesh_summary
        return f"<mesh of '{self.case.id}': {grouped(found.tets)} tetrahedra, {counted(found.dofs, 'unknown')}>"

    def to_dict(self) -> dict[str, Any]:
        """A JSON document, schema palpate.mesh/1."""
        document = {"schema": "palpate.mesh/1", "id": self.case.id, "mesh": _plain(self.mesh_summary)}
        return json_object(document | closing(self.case, self.provenance, self.remarks))


@dataclass(frozen=True, slots=True)
class Simulation:
    """A simulated later state.

    displacements: one (n_points, 3) mm on `space.points` a step, the last one the whole motion; before, after: label
    images; moduli_kpa: Young's modulus of each meshed tissue, kPa.
    """

    case: Case
    space: LagrangeSpace
    mesh_summary: MeshSummary
    displacements: tuple[NDArray[np.float64], ...]
    before: LabelImage
    after: LabelImage
    moduli_kpa: Mapping[str, float]
    provenance: Provenance
    remarks: tuple[Finding, ...] = ()

    def __repr__(self) -> str:
        """One line."""
        largest = float(np.linalg.norm(self.displacements[-1], axis=1).max())
        steps = counted(len(self.displacements), "step")
        return f"<simulation of '{self.case.id}': {steps}, largest displacement {largest:.2f} mm>"

    def to_dict(self) -> dict[str, Any]:
        """A JSON document, schema palpate.simulation/1."""
        length = np.linalg.norm(self.displacements[-1], axis=1)
        document = {
            "schema": "palpate.simulation/1",
            "id": self.case.id,
            "law": self.case.mechanics.law,
            "element": self.case.mechanics.element,
            "youngs_modulus_kpa": dict(self.moduli_kpa),
            "largest_displacement_mm": float(length.max()),
            "steps": len(self.displacements),
            "mesh": _plain(self.mesh_summary),
        }
        return json_object(document | closing(self.case, self.provenance, self.remarks))


def failure_document(case: Case, error: PalpateError) -> dict[str, Any]:
    """`result.json` of an estimate that ended in `error`: every key, no value."""
    status = "not converged" if isinstance(error, NotConverged) else "failed"
    why = f"the estimation ended with the status '{status}'"
    unknown = [tissue.name for tissue in case.tissues if tissue.role is Role.ESTIMATE]
    known = [tissue.name for tissue in case.tissues if tissue.role is Role.KNOWN]
    absolute, sought = stated_unit(case) == "kPa", unknown if case.estimate.seeks_poisson_ratios else []
    moduli = [no_estimate(name, absolute=absolute, relative_to=(known or unknown)[0], why=why) for name in unknown]
    empty: dict[str, Any] = {
        "estimates": [
            *(_estimate(item, status) for item in moduli),
            *(_ratio(no_ratio(name, why=why), status) for name in sought),
        ],
        "correlation": [],
        "information": None,
        "combinations": [],
        "regions": [],
        "image_pairs": None,
        "built_on": None,
        "explanations": [],
        "samples": None,
        "alignment": [],
        "fit": [],
        "starts": [],
        "outer_loop": {"history_mm2": []},
        **_discrepancy(FoundDiscrepancy(), []),
        "observations": {},
        "counts": {},
        "mesh": None,
        "note": "",
    }
    return json_object(_heading(case, status, str(error)) | empty | closing(case, Provenance(), ()))


def stated_unit(case: Case) -> str:
    """Unit of the moduli that a case asks for: "kPa", or "ratio" when neither a modulus nor a load is known."""
    return _unit(case, case.tissues)


def _unit(case: Case, tissues: Sequence[Tissue | CaseTissue]) -> str:
    known = any(tissue.role is Role.KNOWN for tissue in tissues) or case.phantom is not None  # whose surroundings are
    return "kPa" if known or case.known_force else "ratio"


def json_object(mapping: Mapping[str, Any]) -> dict[str, Any]:
    """`mapping` in JSON's own types: tuples as lists, numpy numbers as numbers, NaN and infinity as null."""
    return {str(key): _json(item) for key, item in mapping.items()}


def _json(value: Any) -> Any:
    if isinstance(value, Mapping):
        return json_object(value)
    if isinstance(value, list | tuple | np.ndarray):
        return [_json(item) for item in value]
    if isinstance(value, np.generic):
        value = value.item()
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    return str(value) if isinstance(value, Path) else value


def _plain(value: Any) -> dict[str, Any]:
    """The fields of a dataclass, not copied; slots leave no __dict__."""
    return {item.name: getattr(value, item.name) for item in fields(value)}


def _heading(case: Case, status: str, reason: str) -> dict[str, Any]:
    return {
        "schema": SCHEMA,
        "id": case.id,
        "patient": case.patient,
        "stage": case.stage,
        "status": status,
        "reason": reason,
        "law": case.mechanics.law,
        "element": case.mechanics.element,
        "method": case.estimate.method,
    }


def closing(case: Case, provenance: Provenance, remarks: tuple[Finding, ...]) -> dict[str, Any]:
    """How every document of a case ends: seconds, inputs, versions, the case as it was run, seed, warnings."""
    return {
        "seconds": dict(provenance.seconds),
        "inputs": {key: {"sha256": digest} for key, digest in provenance.inputs.items()},
        "versions": dict(provenance.versions),
        "case": case_tables(case, lambda path: path.name),
        "overrides": list(case.overrides),
        "seed": case.seed,
        "warnings": warning_rows(remarks),
    }


def _estimate(item: ModulusEstimate, status: str) -> dict[str, Any]:
    """One entry of "estimates"; an estimate that did not converge must not look like a result."""
    document = _plain(item)
    if status != "converged":
        document |= dict.fromkeys(("value", "interval95", "interval95_given_model", "ratio", "ratio_interval95"))
        document["verdict"] = NOT_IDENTIFIED
    return document


def _ratio(item: PoissonRatioEstimate, status: str) -> dict[str, Any]:
    """One entry of "estimates" for a Poisson's ratio, under the keys of a modulus."""
    document = _plain(item) | {"parameter": "poisson_ratio", "unit": "1", "relative_to": "", "truth": None}
    document |= {"ratio": None, "ratio_interval95": None, "interval_kind": "linearised", "profile": []}
    if status != "converged":
        document |= dict.fromkeys(("value", "interval95")) | {"verdict": NOT_IDENTIFIED}
    return document


def _explanation(of: StatedExplanation, names: Sequence[str]) -> dict[str, Any]:
    """One entry of "explanations", with the later images by their names."""
    images = [{"after": name, "shows": list(words)} for name, words in zip(names, of.images, strict=False)]
    return {"probability": of.probability, "scenario": list(of.scenario), "images": images, "moduli": dict(of.moduli)}


def _map(of: StiffnessMap, names: Sequence[str]) -> dict[str, Any]:
    """What a map comes to; its numbers stand in mesh.vtu and in the images of stiffness."""
    region = of.region and {key: value for key, value in _plain(of.region).items() if key != "elements"}
    return {
        "tissue": of.tissue,
        "after": names[of.state],
        "prior_sd": of.prior_sd,
        "resolved": of.resolved,
        "words": map_summary(of),
        "region": region,
    }


def _discrepancy(found: FoundDiscrepancy, names: Sequence[str]) -> dict[str, Any]:
    """The keys that say what frame, drawing and material were found to do."""
    return {
        "frame": [{"after": name} | _plain(of) for name, of in zip(names, found.frame, strict=False) if of is not None],
        "offsets": [
            {"after": names[of.state], "tissue": of.tissue, "mm": of.mm, "interval95": of.interval95}
            for of in found.offsets
        ],
        "heterogeneity": [_plain(of) for of in found.heterogeneity],
        "layers": [_plain(of) for of in found.layers],
        "poisson_ratios": [_plain(of) for of in found.poisson_ratios],
    }
