"""report.html of one case: one self-contained file."""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from datetime import UTC, datetime
from functools import partial
from pathlib import Path
from typing import Any

import jinja2
from markupsafe import Markup

from palpate.errors import PalpateError
from palpate.images.readers import read_intensities
from palpate.report.charts import angle_svg, modulus_svg, objective_svg
from palpate.report.colours import START_COLOURS
from palpate.report.rows import estimate_rows, number
from palpate.report.slices import GreyImage, choose_planes, contour_names, slice_svg
from palpate.study.case import Case
from palpate.study.outputs import write_text
from palpate.study.result import CaseResult, failure_document

__all__ = ["write_case_report", "write_failure_report"]

LOGGER = logging.getLogger(__name__)
MOST_IMAGES = 4  # later images whose slices are drawn; a page of more is not read


@dataclass(frozen=True, slots=True)
class _Picture:
    """A figure of the page, or the reason why there is none."""

    title: str
    svg: Markup | None
    missing: str = ""


def write_case_report(result: CaseResult, folder: Path) -> Path:
    """Write `folder`/report.html, whole or not at all, and return its path.

    A figure that cannot be drawn leaves a sentence in its place. Raises `ResourceError` when the disk refuses.
    """
    page = _render(
        case=result.case,
        tissues=result.tissues,
        document=result.to_dict(),
        rows=estimate_rows(result),
        starts=_start_rows(result),
        slices=_slices(result),
        contours=contour_names(result),
        curves=_curves(result),
        angles=_picture("Dihedral angles of the mesh", partial(angle_svg, result.space.mesh, name="angles")),
    )
    path = folder / "report.html"
    write_text(path, page)
    return path


def write_failure_report(case: Case, error: PalpateError, folder: Path) -> Path:
    """Write `folder`/report.html of an estimate that ended in `error`, and return its path; raises as above."""
    page = _render(
        case=case,
        tissues=case.tissues,
        document=failure_document(case, error),
        rows=(),
        starts=(),
        slices=(),
        contours=(),
        curves=(),
        angles=None,
    )
    path = folder / "report.html"
    write_text(path, page)
    return path


def _render(**context: Any) -> str:
    environment = jinja2.Environment(
        loader=jinja2.PackageLoader("palpate.report"), autoescape=True, undefined=jinja2.StrictUndefined
    )
    environment.filters["number"] = number
    created = datetime.now(UTC).strftime("%Y-%m-%d %H:%M UTC")
    template = environment.get_template("case.html")
    return str(template.render(created=created, settings=_settings(context["case"]), **context))


def _settings(case: Case) -> tuple[tuple[str, str], ...]:
    """What the case asked for, in words."""
    mechanics, domain, driver = case.mechanics, case.domain, case.driver
    margin = f", {domain.margin_mm:g} mm around the organs" if domain.extent == "margin" else ""
    return (
        ("material law", mechanics.law),
        ("element", mechanics.element),
        ("edge length at the organs", f"{case.mesh.edge_length_mm:g} mm"),
        ("outer boundary", f"{domain.outer_boundary}; domain: {domain.extent}{margin}"),
        ("alignment", case.align),
        ("driver motion", f"{driver.modes} modes, kernel {driver.kernel_mm:g} mm, prior {driver.prior_mm:g} mm"),
        ("method", case.estimate.method),
        ("seed", str(case.seed)),
    )


def _start_rows(result: CaseResult) -> tuple[Mapping[str, Any], ...]:
    return tuple(
        {
            "colour": START_COLOURS[i % len(START_COLOURS)],
            "start": start.start,
            "end": start.end,
            "objective": start.objective_mm2,
            "iterations": start.iterations,
            "status": start.status,
            "minimum": start.minimum,
        }
        for i, start in enumerate(result.estimation.starts)
    )


def _slices(result: CaseResult) -> tuple[tuple[str, tuple[_Picture, ...]], ...]:
    """The three slices of each later image, under its name."""
    grey = _grey(result)
    images = result.case.images
    names = [path.name for path in images.after] if images else ["after"] * len(result.after)
    try:
        planes = choose_planes(result)
    except Exception as error:
        LOGGER.warning("no slices: %s", error)
        return ()
    return tuple(
        (
            name,
            tuple(
                _picture(
                    plane.view.name,
                    partial(slice_svg, result, plane, after=k, grey=grey, name=f"s{k}{plane.view.name}"),
                )
                for plane in planes
            ),
        )
        for k, name in enumerate(names[: min(MOST_IMAGES, len(result.after))])
    )


def _grey(result: CaseResult) -> GreyImage | None:
    images = result.case.images
    if images is None or images.intensities_before is None:
        return None
    try:
        return read_intensities(images.intensities_before)
    except PalpateError as error:
        LOGGER.warning("the grey image is left out of the report: %s", error)
        return None


def _curves(result: CaseResult) -> tuple[_Picture, ...]:
    estimation = result.estimation
    pictures = [_picture("Misfit", partial(objective_svg, estimation, name="misfit"))]
    for i, estimate in enumerate(estimation.estimates):
        draw = partial(modulus_svg, estimation, estimate, name=f"modulus{i}")
        pictures.append(_picture(f"Stiffness of {estimate.tissue}", draw))
    return tuple(pictures)


def _picture(title: str, draw: Callable[[], str]) -> _Picture:
    """The figure that `draw` makes, which is our own SVG and therefore safe to embed."""
    try:
        return _Picture(title, Markup(draw()))  # noqa: S704 - drawn by svg.py, where names become outlines
    except Exception as error:
        LOGGER.warning("the figure '%s' could not be drawn: %s", title, error, exc_info=True)
        return _Picture(title, None, f"This figure could not be drawn ({type(error).__name__}: {error}).")
