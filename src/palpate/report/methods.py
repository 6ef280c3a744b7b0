"""The methods section that a paper about the result would need, with the works it cites (assets/sources.bib)."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from importlib import resources
from typing import Any

from palpate.mechanics.laws.contract import Law
from palpate.mechanics.laws.registry import LAWS, law_from, law_parameters
from palpate.report.report_data import MAP_OF, MESH, ReportData
from palpate.report.rows import CAUSES, listed, moduli_in, ratio_rows
from palpate.report.units import given_text
from palpate.unknowns import KNOWN_MODULUS

ELEMENTS = {
    "P1": "linear tetrahedra",
    "P2": "quadratic tetrahedra",
    "P2-P0": "quadratic tetrahedra with the mean dilatation of each",
    "auto": "quadratic tetrahedra whose volumetric stiffness is partly that of their mean dilatation, against locking",
}
ALIGNED = {
    "rigid-tissues": " The later images were brought to the first on the rigid tissues.",
    "surfaces": " The later images were brought to the first by the rigid motion that most of the surfaces agree on.",
}
UNKNOWNS = tuple(cause for cause in CAUSES if cause not in ("noise", "prior", "grid", "mesh"))
GIVEN = {"frame": "the boundary condition", "poisson": "given Poisson's ratios", KNOWN_MODULUS: "the given moduli"}


@dataclass(frozen=True, slots=True)
class Methods:
    """Paragraphs with numbers in brackets, the sources that they stand for, and these as a BibTeX file."""

    paragraphs: tuple[str, ...]
    sources: tuple[str, ...]
    bibtex: str


def methods_text(data: ReportData) -> Methods:
    """What was done to the images of this case, in sentences that can be taken over."""
    cited: dict[str, int] = {}

    def cite(key: str) -> str:
        """The number of a source, in the order in which they are cited."""
        return f"[{cited.setdefault(key, len(cited) + 1)}]"

    leaning = listed([item["tissue"] for item in moduli_in(data.document) if item.get("interval_kind") == "profile"])
    if leaning:
        leaning = f"; of {leaning}, whose profile likelihood leans to one side, they follow the profile"
    # which unknowns the intervals allow for, and the errors of what is given, which they do not cover
    shares = [share for item in moduli_in(data.document) for share in (item.get("variance_shares") or {}).items()]
    counted = {cause for cause, share in shares if share > 0.0}
    allowed = listed([CAUSES[cause] for cause in UNKNOWNS if cause in counted])
    given = listed(["the material law", *(words for cause, words in GIVEN.items() if cause not in counted)])
    covered = (f" They allow for {allowed}." if allowed else "") + f" They do not cover the errors of {given}."
    law = _law(data)
    onwards = " The linear law gave the start; the fit then went on over expansions around finite-strain equilibria."
    observed = listed(list(data.document.get("observations", {}).values())) or "what the case's observations compare"
    paragraphs = (
        _aim(data, cite),
        _model(data, cite),
        (
            f"The misfit was {observed}. Outliers counted less: by densities with the tails of a power law, on the"
            f" drivers' walls by Huber's loss {cite('huber')}. The posterior of the moduli's logarithms was a"
            " mixture over what may explain the images: how patchy the tissues are, whether layers lie round organs,"
            " whether the frame moves, and whether each image draws the surfaces alike. Each explanation counted"
            " by its evidence: all unknowns that act on no modulus were integrated out, and Laplace's approximation"
            f" {cite('laplace')} was taken of what is left. Its minimum was found by Newton's method, corrected by"
            f" the last step {cite('nocedal')}, on reduced models {cite('reduced')}, which were made exact at the mean"
            " of each group of explanations."
            f" {len(data.document['starts'])} starts looked for other minima."
            f"{onwards if law is not None and law.finite else ''}"
        ),
        (
            "Values are medians, and 95 % intervals quantiles, of that mixture. They are wider by spatially correlated"
            f" residuals (sandwich covariance {cite('white')}), the scatter over the voxel grid's position and a term"
            " for the mesh"
            f"{leaning}.{covered} The seed of random numbers was {data.document['seed']}."
        ),
    )
    own = SOURCES["palpate"]
    version = {"version": str(data.document["versions"].get("palpate", ""))}
    sources = SOURCES | {"palpate": replace(own, fields={**own.fields, **version})}
    return Methods(
        paragraphs,
        tuple(reference_line(sources[key]) for key in cited),
        "\n\n".join(bibtex(key, sources[key]) for key in cited),
    )


def _aim(data: ReportData, cite: Callable[[str], str]) -> str:
    roles: dict[str, list[str]] = {}
    for tissue in data.tissues:
        roles.setdefault(tissue.role, []).append(tissue.name)
    aligned = ALIGNED.get(dict(data.settings).get("alignment", ""), "")
    known = [
        f"{t.name} ({given_text(data.document, t.name, t.given_kpa)})" for t in data.tissues if t.given_kpa is not None
    ]
    moved = f" The motion was driven by {listed(roles['driver'])} (hollow, not meshed)." if "driver" in roles else ""
    source = "segmented images of the same body in two or more states"
    if dict(data.settings).get("body") == MESH:
        source = "measurements of one body, given as a mesh, in two or more states"
    scale = " No modulus was given, so only ratios were found."
    forces = ["the measured forces"] if data.document.get("forces") else []
    if known or data.unit == "kPa":
        scale = f" The scale was set by {listed(known or forces or ['the known loads'])}."
    return (
        f"Young's moduli of {listed(roles.get('estimate', []))} were estimated at once from {source} with"
        f" Palpate {cite('palpate')}, whose method starts from {cite('yang')}.{moved}{aligned}{scale}"
    )


def _model(data: ReportData, cite: Callable[[str], str]) -> str:
    document: Mapping[str, Any] = data.document
    mesh = document["mesh"]
    size = f" of {mesh['tets']} tetrahedra with {mesh['dofs']} unknowns" if mesh else ""
    pairs = len(document.get("pairs", ()))
    more = (
        f" Each of {pairs + 1} pairs of images had a mesh of its own, of which the first is told of." if pairs else ""
    )
    loads = [words for key, words in data.settings if key == "known load"]
    acted = f" Known loads acted on the later states: {'; '.join(loads)}." if loads else ""
    settings, law = dict(data.settings), _law(data)
    sought = [row.tissue for row in ratio_rows(document)]
    given = [t for t in data.tissues if t.role in ("estimate", "known") and t.name not in sought]
    ratios = sorted({f"{t.poisson_ratio:g}" for t in given})
    constants = [f"Poisson's ratios of {listed(ratios)}"] if ratios else []
    constants += [f"Poisson's ratios of {listed(sought)} as unknowns beside the moduli"] if sought else []
    priors = {key.removeprefix(MAP_OF): prior for key, prior in data.settings if key.startswith(MAP_OF)}
    fields = listed([f"{name} ({prior})" for name, prior in priors.items()])
    made = (
        "The label images were turned into signed distance maps by Gaussian smoothing and the probit of the smoothed"
        " share."
        f" A conforming mesh{size} (edge length {settings['edge length at the organs']} at the organs) was cut along"
        f" their zero levels and improved with Mmg {cite('mmg')}.{more}"
    )
    if settings.get("body") == MESH:
        made = f"The mesh{size} was given."
    kernel = cite("kernel")
    mapped = f" Inside {fields} ln E was a field." if priors else ""
    return (
        f"{made} The tissues followed"
        f" {law.description if law else 'the law ' + document['law']} in"
        f" {ELEMENTS.get(document['element'], str(document['element']))}, with {listed(constants)};"
        " each was one solid, so that the modulus of an organ with a wall around a fluid, as a bladder, is an effective"
        f" one, not its wall's. The outer boundary: {settings['outer boundary']}. The motion of the drivers' walls was"
        f" a Gaussian process in its leading modes ({settings['driver motion']}) {kernel}, estimated together"
        f" with the moduli.{mapped}{acted}"
    )


def _law(data: ReportData) -> Law | None:
    """The material law with its parameters; None for one that this version has not."""
    settings = dict(data.settings)
    stated = {name: float(settings[name]) for name in law_parameters() if name in settings}
    return law_from(data.document["law"], stated) if data.document["law"] in LAWS else None


@dataclass(frozen=True, slots=True)
class Source:
    """A cited work: BibTeX's kind of entry, and its fields as they stand there."""

    kind: str
    fields: Mapping[str, str]

    @property
    def title(self) -> str:
        """Its title, without the braces that keep capitals."""
        return self.fields["title"].strip("{}")


FILE = (resources.files("palpate.report") / "assets" / "sources.bib").read_text(encoding="utf-8")
SOURCES = {
    key: Source(kind, dict(re.findall(r"^  (\w+) = \{(.*)\},?$", fields, re.MULTILINE)))
    for kind, key, fields in re.findall(r"^@(\w+)\{(\w+),$(.*?)^\}$", FILE, re.MULTILINE | re.DOTALL)
}


def reference_line(source: Source) -> str:
    """The source as a line of a list of references: "Family AB", or a body's name, of each author; title, and where."""
    fields, names = source.fields, list[str]()
    for author in fields["author"].split(" and "):
        family, _, given = author.strip("{}").partition(", ")
        names.append(f"{family} {''.join(part[0] for part in given.split())}".strip())
    title = f"{source.title}, {fields['edition']} ed." if "edition" in fields else f"{source.title}."
    rest = ""
    if source.kind == "article":
        pages = fields["pages"].replace("--", "-")
        rest = f" {fields['journal']} {fields['volume']} ({fields['year']}) {pages}."
    elif source.kind == "book":
        rest = f" {fields['publisher']}, {fields['year']}."
    elif "version" in fields:
        rest = f" Version {fields['version']}, {fields['url']}"
    return f"{', '.join(names)}. {title}{rest}"


def bibtex(key: str, source: Source) -> str:
    """The source as an entry of a BibTeX file under `key`."""
    lines = [f"  {name} = {{{value}}}" for name, value in source.fields.items()]
    return f"@{source.kind}{{{key},\n" + ",\n".join(lines) + "\n}"
