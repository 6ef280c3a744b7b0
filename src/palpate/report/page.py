"""The page: every figure tried on its own, everything put into the template."""

from __future__ import annotations

import base64
import hashlib
import logging
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from importlib import resources
from typing import Any, TypeVar

from markupsafe import Markup, escape

from palpate.findings import HARMLESS, WIDENING
from palpate.parallel import mapped
from palpate.report.charts import (
    START_COLOURS,
    angle_svg,
    forces_svg,
    modulus_svg,
    objective_svg,
    profile_svg,
    region_svg,
    repeats_svg,
    residual_svg,
    waterfall_svg,
)
from palpate.report.methods import methods_text
from palpate.report.payload import payload
from palpate.report.pictures import mesh_png, organs_png, points_png
from palpate.report.report_data import LaterImage, MeasuredState, ReportData, SliceBox, TissueMap
from palpate.report.rows import estimate_rows, explanation_rows, headline, moduli_in, ratio_rows, scale_marks
from palpate.report.scales import angle_scale, displacement_scale, distance_scale, modulus_scale, strain_scale
from palpate.report.section import VIEWS, Plane
from palpate.report.slices import (
    alignment_svg,
    arrow_factor,
    contour_names,
    displacement_svg,
    first_planes,
    points_svg,
    slice_svg,
    stiffness_svg,
)
from palpate.report.stiffness_maps import map_png, map_svg
from palpate.report.summary import summary
from palpate.report.svg import template_of
from palpate.report.tornado import coverage, tornado_svg
from palpate.report.units import given_text, shown_correlation, shown_unit

T = TypeVar("T")
LOGGER = logging.getLogger(__name__)
SCRIPTS = (
    *("three.min.js", "report.js", "save.js", "field.js", "slices.js", "alignment.js", "viewer.js", "organs.js"),
    *("mesh.js", "start.js"),
)
OF_POINTS = "points.js"  # before the last, where points were measured
COSTS: tuple[tuple[str, Callable[[str], bool]], ...] = (  # a code that is not ours may cost as much as any
    (
        "The result stands, but each of these can move a modulus by more than its interval.",
        lambda code: code not in (*WIDENING, *HARMLESS),
    ),
    ("Of the images: others would give narrower intervals, or values in kPa.", lambda code: code in WIDENING),
    ("The numbers are as good as without these.", lambda code: code in HARMLESS),
)
POLICY = (
    "default-src 'none'; script-src {hashes}; style-src 'unsafe-inline'; img-src data:; base-uri 'none';"
    " form-action 'none'"
)


@dataclass(frozen=True, slots=True)
class Picture:
    """A figure of the page, or the reason why there is none."""

    title: str
    body: Markup | None
    missing: str = ""


def render(data: ReportData, *, study: bool = False) -> str:
    """The whole page of a report; a figure that cannot be drawn leaves a sentence in its place.

    study: whether its sensitivity.html lies beside it.
    """
    live = _attempt("the moving figures", lambda: payload(data))
    names = (*SCRIPTS[:-1], OF_POINTS, SCRIPTS[-1]) if data.measured else SCRIPTS
    scripts = page_scripts(names) if live is not None and (data.later or data.measured or data.mesh) else ()
    colours = {tissue.name: tissue.colour for tissue in data.tissues}
    found = moduli_in(data.document) if data.document["status"] == "converged" else []
    fixed = {item["tissue"] for item in found if item["verdict"] != "not identified"}  # of others no range is drawn

    def of_moduli(
        title: str, draw: Callable[..., str], name: str, has: Callable[[Mapping[str, Any]], Any]
    ) -> tuple[Picture, ...]:
        """The figure of each modulus that the images fix, where its entry `has` what is drawn."""
        items = [(i, item) for i, item in enumerate(moduli_in(data.document)) if item["tissue"] in fixed and has(item)]
        return tuple(picture_of(title.format(e["tissue"]), partial(draw, data, i, name=f"{name}{i}")) for i, e in items)

    def tornado(data: ReportData, i: int, *, name: str) -> str:
        """What each assumption does to one modulus (its number)."""
        return tornado_svg(data.document, moduli_in(data.document)[i]["tissue"], name=name)

    page = template_of("case.html").render(
        data=data,
        study=study,
        document=data.document,
        headline=headline(data.document),
        summary=summary(data.document),
        unit=shown_unit(data.document),
        correlation=shown_correlation(data.document),
        inputs=tuple(
            tuple(image for image in data.images if image.pair == pair)
            for pair in sorted({image.pair for image in data.images})
        ),
        registrations={row["after"]: row for row in data.document.get("alignment", ())},
        policy=policy_of(scripts),
        scripts=scripts,
        live=live if scripts else None,
        rows=estimate_rows(data.document, colours),
        ratios=ratio_rows(data.document),
        explanations=explanation_rows(data.document),
        marks=scale_marks(data.document),
        starts=_starts(data.document),
        warnings=_warnings(data),
        contours=contour_names(data),
        later=tuple(_later(data, k, later) for k, later in enumerate(data.later)),
        measured=tuple(_measured(data, k, state) for k, state in enumerate(data.measured)),
        forces=(
            picture_of("Measured and fitted forces", partial(forces_svg, data, name="forces"))
            if data.document.get("forces")
            else None
        ),
        maps=tuple(_map(data, k, of) for k, of in enumerate(data.maps)),
        mesh_pictures=_mesh_pictures(data),
        moduli=_attempt("the scale of the moduli", lambda: modulus_scale(data)) if data.mesh else None,
        curves=_curves(data),
        profiles=of_moduli("Profile of {}", profile_svg, "profile", lambda item: item.get("profile")),
        regions=tuple(
            picture_of(" and ".join(region["tissues"]), partial(region_svg, data, i, name=f"region{i}"))
            for i, region in enumerate(data.document.get("regions", ()))
            if fixed.issuperset(region["tissues"])
        ),
        tornados=of_moduli("{}", tornado, "change", lambda _: data.document.get("variations")),
        coverage=coverage(data.document),
        given_text=given_text,
        repeats=of_moduli("Repeats of {}", repeats_svg, "repeats", lambda _: data.document["image_pairs"]),
        angles=(
            picture_of("Dihedral angles of the mesh", partial(angle_svg, data.mesh.angles, name="angles"))
            if data.mesh
            else None
        ),
        methods=(  # where nothing converged there is no result whose methods could be told
            _attempt("the methods text", lambda: methods_text(data)) if data.document["status"] == "converged" else None
        ),
        angle_scale=angle_scale(),
        strain_scale=strain_scale() if data.mesh and len(data.mesh.strains) else None,
    )
    return str(page)


def _starts(document: Mapping[str, Any]) -> tuple[Mapping[str, Any], ...]:
    """The starts with their colours, and moduli in the unit that is shown."""
    unit = shown_unit(document)

    def shown(moduli: Mapping[str, float | None]) -> dict[str, float | None]:
        """Moduli by tissue, where there are some."""
        return {tissue: value and unit.of_document(value) for tissue, value in moduli.items()}

    return tuple(
        start
        | {
            "colour": START_COLOURS[i % len(START_COLOURS)],
            "start": shown(start["start"]),
            "end": shown(start["end"]),
        }
        for i, start in enumerate(document["starts"])
    )


def page_scripts(names: Sequence[str]) -> tuple[Markup, ...]:
    """Scripts by their names, as they stand in the package."""
    folder = resources.files("palpate.report") / "assets"
    return tuple(Markup((folder / name).read_text(encoding="utf-8")) for name in names)  # noqa: S704 - our own files


def policy_of(scripts: tuple[Markup, ...]) -> Markup:
    """The Content-Security-Policy that lets these scripts run and nothing else be loaded or run."""
    digests = [base64.b64encode(hashlib.sha256(script.encode()).digest()).decode() for script in scripts]
    hashes = " ".join(f"'sha256-{digest}'" for digest in digests) or "'none'"
    return Markup(POLICY.format(hashes=hashes))  # noqa: S704 - our own words and base64


def _warnings(data: ReportData) -> tuple[tuple[str, tuple[tuple[str, tuple[str, ...]], ...]], ...]:
    """A caption with the codes and messages of the warnings under it, those of one code together, for each cost."""
    groups: dict[str, list[str]] = {}
    for warning in data.document["warnings"]:
        groups.setdefault(str(warning["code"]), []).append(str(warning["message"]))
    said = {code: (code, tuple(messages)) for code, messages in groups.items()}
    if data.document["status"] != "converged":
        return (("There is no result; these were noticed on the way.", tuple(said.values())),)
    costs = ((caption, tuple(said[code] for code in said if fits(code))) for caption, fits in COSTS)
    return tuple((caption, codes) for caption, codes in costs if codes)


def _later(data: ReportData, k: int, later: LaterImage) -> Mapping[str, Any]:
    """The figures of one later image."""
    reference = data.references[later.reference]
    planes = first_planes(reference.slices) if reference.slices else ()
    whole = reference.whole if later.both else None
    return {
        "name": later.name,
        "alignment": tuple(
            picture_of(plane.view.name, partial(alignment_svg, data, plane, later, name=f"a{k}{plane.view.name}"))
            for plane in (first_planes(whole) if whole else ())
        ),
        "whole_widths": widths_of(whole),
        "slices": tuple(
            picture_of(plane.view.name, partial(slice_svg, data, plane, later, name=f"s{k}{plane.view.name}"))
            for plane in planes
        ),
        "fields": tuple(_fields(data, k, later, planes)),
        "organs": _photographs(
            {
                f"as in {reference.name}": partial(organs_png, data, later, fitted=False),
                f"fitted to {later.name}": partial(organs_png, data, later, fitted=True),
            }
        ),
        "residuals": tuple(
            picture_of(
                data.tissues[model.tissue].name,
                partial(residual_svg, data, model, voxel_mm=reference.voxel_mm, name=f"r{k}t{model.tissue}"),
            )
            for model in later.model
        ),
        "scale": distance_scale(reference.voxel_mm),
        "reference": reference,
        "widths": widths_of(reference.slices),
    }


def _fields(data: ReportData, k: int, later: LaterImage, planes: Sequence[Plane]) -> Iterator[Mapping[str, Any]]:
    """What the model found in colours over the slices of one later image: moduli, and the fitted motion."""
    if data.mesh is None or later.reference or not planes:
        return

    def pictures(draw: Callable[..., str], letter: str) -> tuple[Picture, ...]:
        """One of each plane."""
        names = [f"{letter}{k}{plane.view.name}" for plane in planes]
        drawn = zip(planes, names, strict=True)
        return tuple(picture_of(p.view.name, partial(draw, data, p, later, name=name)) for p, name in drawn)

    if any(tissue.modulus and tissue.role == "estimate" for tissue in data.tissues):
        words = "Coloured: the organs whose modulus was estimated. The bar's range includes given moduli."
        yield {
            "of": "stiffness",
            "title": "Young's modulus",
            "words": words,
            "pictures": pictures(stiffness_svg, "e"),
            "scale": modulus_scale(data),
        }
    if len(later.motion):
        factor = arrow_factor(later)
        longer = "as long as the motion" if factor == 1.0 else f"{factor:g} times as long as the motion"
        yield {
            "of": "motion",
            "title": "displacement",
            "words": f"Coloured: the length of the fitted motion to {later.name}. White arrows, {longer}, show its part"
            " in the slice.",
            "pictures": pictures(displacement_svg, "d"),
            "scale": displacement_scale(later),
        }


def _measured(data: ReportData, k: int, state: MeasuredState) -> Mapping[str, Any]:
    """The figures of the points that were measured in one later state."""
    return {
        "state": state,
        "reference": data.references[state.reference],
        "slices": tuple(
            picture_of(plane.view.name, partial(points_svg, data, plane, state, name=f"p{k}{plane.view.name}"))
            for plane in first_planes(state.box)
        ),
        "space": _photographs({f"motion to {state.name}": partial(points_png, data, state)}),
        "widths": widths_of(state.box),
    }


def _map(data: ReportData, k: int, of: TissueMap) -> Mapping[str, Any]:
    """The figures of one map of stiffness."""
    name, draw = data.tissues[of.tissue].name, partial(map_svg, data, of, name=f"map{k}")
    return {
        "tissue": name,
        "words": of.words,
        "slices": picture_of(f"{name}: modulus and its standard deviation", draw),
        "space": _photographs({f"{name}, cut open": partial(map_png, data, of)}),
    }


def widths_of(box: SliceBox | None) -> str:
    """Of the columns of three slices, as CSS, so that all show a millimetre in the same size."""
    return "" if box is None else " ".join(f"{box.high[v.across] - box.low[v.across]:.1f}fr" for v in VIEWS)


def _mesh_pictures(data: ReportData) -> tuple[Picture, ...]:
    if data.mesh is None:
        return ()
    drawings = {
        "coloured by tissue": partial(mesh_png, data, by="tissue"),
        "coloured by Young's modulus": partial(mesh_png, data, by="modulus"),
    }
    if len(data.mesh.strains):
        drawings["coloured by the largest strain"] = partial(mesh_png, data, by="strain")
    return _photographs(drawings)


def _curves(data: ReportData) -> tuple[Picture, ...]:
    if not data.document["starts"]:
        return ()
    moduli = [
        picture_of(f"Stiffness of {item['tissue']}", partial(modulus_svg, data, i, name=f"modulus{i}"))
        for i, item in enumerate(moduli_in(data.document))
    ]
    return (
        picture_of("Misfit", partial(objective_svg, data, name="misfit")),
        picture_of("Waterfall of the starts", partial(waterfall_svg, data, name="waterfall")),
        *moduli,
    )


def _photographs(drawings: Mapping[str, Callable[[], bytes]]) -> tuple[Picture, ...]:
    """The PNG that each drawing makes, by its title, as images of the page; made side by side."""

    def element(title: str) -> str:
        """The image as an HTML element that holds its own data."""
        source = base64.b64encode(drawings[title]()).decode()
        return f'<img alt="{escape(title)}" src="data:image/png;base64,{source}">'

    return tuple(mapped(lambda title: picture_of(title, partial(element, title)), drawings))


def picture_of(title: str, draw: Callable[[], str]) -> Picture:
    """The figure that `draw` makes, which is our own SVG or image and therefore safe to embed."""
    try:
        return Picture(title, Markup(draw()))  # noqa: S704 - drawn by svg.py, where names become outlines
    except Exception as error:
        LOGGER.warning("the figure '%s' could not be drawn: %s", title, error, exc_info=True)
        return Picture(title, None, f"This figure could not be drawn ({type(error).__name__}: {error}).")


def _attempt(what: str, make: Callable[[], T]) -> T | None:
    """What `make` returns, or None with a warning in the log."""
    try:
        return make()
    except Exception as error:
        LOGGER.warning("the report is without %s: %s", what, error, exc_info=True)
        return None
