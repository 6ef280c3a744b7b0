"""The page: every figure tried on its own, everything put into the template."""

from __future__ import annotations

import base64
import hashlib
import logging
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from importlib import resources
from itertools import groupby
from typing import Any, TypeVar

from markupsafe import Markup, escape

from palpate.findings import HARMLESS, WIDENING
from palpate.parallel import mapped
from palpate.report import charts
from palpate.report.charts import START_COLOURS
from palpate.report.methods import methods_text
from palpate.report.payload import payload
from palpate.report.pictures import mesh_png, organs_png, points_png
from palpate.report.report_data import LaterImage, MeasuredState, ReportData, SliceBox
from palpate.report.rows import estimate_rows, explanation_rows, headline, moduli_in, ratio_rows, scale_marks
from palpate.report.scales import angle_scale, displacement_scale, distance_scale, modulus_scale, strain_scale
from palpate.report.section import VIEWS
from palpate.report.slices import (
    alignment_chart,
    arrow_factor,
    contour_names,
    displacement_chart,
    first_planes,
    longer,
    points_chart,
    slice_chart,
    stiffness_chart,
)
from palpate.report.stiffness_maps import map_chart, map_png
from palpate.report.summary import summary
from palpate.report.svg import draw_svg, page_of
from palpate.report.tornado import coverage, tornado
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
    document, converged = data.document, data.document["status"] == "converged"
    found = moduli_in(document) if converged else []
    fixed = {item["tissue"] for item in found if item["verdict"] != "not identified"}  # of others no range is drawn

    def of_moduli(title: str, chart: Callable[..., str], has: Callable[[Mapping[str, Any]], Any]) -> list[Picture]:
        """The figure of each modulus that the images fix, where its entry `has` what is drawn."""
        items = [item for item in found if item["tissue"] in fixed and has(item)]
        return [picture_of(title.format(item["tissue"]), chart, data, item) for item in items]

    return page_of(
        "case.html",
        data=data,
        study=study,
        document=document,
        headline=headline(document),
        summary=summary(document),
        unit=shown_unit(document),
        correlation=shown_correlation(document),
        inputs=[list(pair) for _, pair in groupby(data.images, key=lambda image: image.pair)],
        registrations={row["after"]: row for row in document.get("alignment", ())},
        policy=policy_of(scripts),
        scripts=scripts,
        live=live if scripts else None,
        rows=estimate_rows(document, {tissue.name: tissue.colour for tissue in data.tissues}),
        ratios=ratio_rows(document),
        explanations=explanation_rows(document),
        marks=scale_marks(document),
        starts=_starts(document),
        warnings=_warnings(document),
        contours=contour_names(data),
        later=[_later(data, later) for later in data.later],
        measured=[_measured(data, state) for state in data.measured],
        forces=picture_of("Measured and fitted forces", charts.forces, document) if document.get("forces") else None,
        maps=[
            {
                "tissue": (name := data.tissues[of.tissue].name),
                "words": of.words,
                "slices": picture_of(f"{name}: modulus and its standard deviation", map_chart, data, of),
                "space": _photographs({f"{name}, cut open": partial(map_png, data, of)}),
            }
            for of in data.maps
        ],
        mesh_pictures=_mesh_pictures(data),
        moduli=_attempt("the scale of the moduli", lambda: modulus_scale(data)) if data.mesh else None,
        curves=_curves(data),
        profiles=of_moduli("Profile of {}", charts.profile, lambda item: item.get("profile")),
        regions=[
            picture_of(" and ".join(region["tissues"]), charts.region, data, region)
            for region in document.get("regions", ())
            if fixed.issuperset(region["tissues"])
        ],
        tornados=of_moduli(
            "{}",
            lambda figure, _, item: tornado(figure, document, item["tissue"]),
            lambda _: document.get("variations"),
        ),
        coverage=coverage(document),
        given_text=given_text,
        repeats=of_moduli("Repeats of {}", charts.repeats, lambda _: document["image_pairs"]),
        angles=picture_of("Dihedral angles of the mesh", charts.angles, data.mesh.angles) if data.mesh else None,
        # where nothing converged there is no result whose methods could be told
        methods=_attempt("the methods text", lambda: methods_text(data)) if converged else None,
        angle_scale=angle_scale(),
        strain_scale=strain_scale() if data.mesh and len(data.mesh.strains) else None,
    )


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


def _warnings(document: Mapping[str, Any]) -> tuple[tuple[str, tuple[tuple[str, tuple[str, ...]], ...]], ...]:
    """A caption with the codes and messages of the warnings under it, those of one code together, for each cost."""
    groups: dict[str, list[str]] = {}
    for warning in document["warnings"]:
        groups.setdefault(str(warning["code"]), []).append(str(warning["message"]))
    said = {code: (code, tuple(messages)) for code, messages in groups.items()}
    if document["status"] != "converged":
        return (("There is no result; these were noticed on the way.", tuple(said.values())),)
    costs = ((caption, tuple(said[code] for code in said if fits(code))) for caption, fits in COSTS)
    return tuple((caption, codes) for caption, codes in costs if codes)


def _later(data: ReportData, later: LaterImage) -> Mapping[str, Any]:
    """The figures of one later image."""
    reference = data.references[later.reference]
    whole = reference.whole if later.both else None
    titles = (f"as in {reference.name}", f"fitted to {later.name}")
    organs = {title: partial(organs_png, data, later, fitted=bool(k)) for k, title in enumerate(titles)}
    return {
        "name": later.name,
        "alignment": slices_of(whole, alignment_chart, data, later),
        "whole_widths": widths_of(whole),
        "slices": slices_of(reference.slices, slice_chart, data, later),
        "fields": tuple(_fields(data, later, reference.slices)),
        "organs": _photographs(organs),
        "residuals": [
            picture_of(data.tissues[model.tissue].name, charts.residuals, data, model, reference.voxel_mm)
            for model in later.model
        ],
        "scale": distance_scale(reference.voxel_mm),
        "reference": reference,
        "widths": widths_of(reference.slices),
    }


def slices_of(box: SliceBox | None, chart: Callable[..., str], data: ReportData, shown: object) -> list[Picture]:
    """A picture of each of the first planes of a box, of what is shown there."""
    planes = first_planes(box) if box else ()
    return [picture_of(plane.view.name, chart, data, plane, shown) for plane in planes]


def _fields(data: ReportData, later: LaterImage, box: SliceBox | None) -> Iterator[Mapping[str, Any]]:
    """What the model found in colours over the slices of one later image: moduli, and the fitted motion."""
    if data.mesh is None or later.reference or box is None:
        return
    if any(tissue.modulus and tissue.role == "estimate" for tissue in data.tissues):
        yield {
            "of": "stiffness",
            "title": "Young's modulus",
            "words": "Coloured: the organs whose modulus was estimated. The bar's range includes given moduli.",
            "pictures": slices_of(box, stiffness_chart, data, later),
            "scale": modulus_scale(data),
        }
    if len(later.motion):
        yield {
            "of": "motion",
            "title": "displacement",
            "words": f"Coloured: the length of the fitted motion to {later.name}. White arrows,"
            f" {longer(arrow_factor(later))}, show its part in the slice.",
            "pictures": slices_of(box, displacement_chart, data, later),
            "scale": displacement_scale(later),
        }


def _measured(data: ReportData, state: MeasuredState) -> Mapping[str, Any]:
    """The figures of the points that were measured in one later state."""
    return {
        "state": state,
        "reference": data.references[state.reference],
        "slices": slices_of(state.box, points_chart, data, state),
        "space": _photographs({f"motion to {state.name}": partial(points_png, data, state)}),
        "widths": widths_of(state.box),
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


def _curves(data: ReportData) -> list[Picture]:
    if not data.document["starts"]:
        return []
    return [
        picture_of("Misfit", charts.objective, data.document),
        picture_of("Waterfall of the starts", charts.waterfall, data.document),
        *(
            picture_of(f"Stiffness of {item['tissue']}", charts.modulus, data, item)
            for item in moduli_in(data.document)
        ),
    ]


def _photographs(drawings: Mapping[str, Callable[[], bytes]]) -> tuple[Picture, ...]:
    """The PNG that each drawing makes, by its title, as images of the page; made side by side."""

    def element(title: str) -> str:
        """The image as an HTML element that holds its own data."""
        source = base64.b64encode(drawings[title]()).decode()
        return f'<img alt="{escape(title)}" src="data:image/png;base64,{source}">'

    return tuple(mapped(lambda title: _tried(title, lambda: element(title)), drawings))


def picture_of(title: str, chart: Callable[..., str], *arguments: object) -> Picture:
    """The figure that a chart draws of its arguments, as SVG."""
    return _tried(title, lambda: draw_svg(lambda figure: chart(figure, *arguments)))


def _tried(title: str, draw: Callable[[], str]) -> Picture:
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
