"""All figures of a result that can be drawn, and why others cannot."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from palpate.errors import EstimationError, InputDataError
from palpate.progress import Line, Progress, silent
from palpate.report.figures.moduli import chosen_unit, moduli_sheet
from palpate.report.figures.motion import motion_caption, motion_gif
from palpate.report.figures.residuals import residual_sheet
from palpate.report.figures.sheet import figure_files
from palpate.report.figures.slices import before_after_sheet, displacement_sheet, stiffness_sheet
from palpate.report.report_data import ReportData, TissueMap
from palpate.report.rows import moduli_in
from palpate.report.scales import shown_stiffness
from palpate.report.stiffness_maps import map_chart
from palpate.report.units import ModulusUnit, shown_unit
from palpate.study.outputs import write_bytes, write_text

LOGGER = logging.getLogger(__name__)
CAPTIONS = "captions.txt"
LARGEST_BOX_MM = 4000.0  # edge of what slices show; a body is smaller


@dataclass(frozen=True, slots=True)
class WrittenFigure:
    """A figure in a folder: its name, its caption and the names of its files; missing: why there is none."""

    name: str
    caption: str
    files: tuple[str, ...]
    missing: str = ""


def write_figures(
    data: ReportData,
    folder: Path,
    *,
    formats: Sequence[str],
    unit: str | None = None,
    dpi: int = 300,
    progress: Progress = silent,
) -> tuple[WrittenFigure, ...]:
    """Write every figure into `folder`, in each of the formats "svg", "pdf", "png", with captions.txt.

    unit: of the moduli, "kPa" or "ratio"; None: both, where both are known. dpi: of pixels. A figure that cannot be
    drawn is told of in the captions. Raises `EstimationError` where nothing converged, `ConfigurationError` for a unit
    in which there are no moduli, `InputDataError` for data that no estimate leaves, `ResourceError` where the disk
    refuses.
    """
    _refuse(data)
    units = units_of(data, unit)
    found = list[WrittenFigure]()
    for name, make in _drawings(data, units):
        progress(Line(f"drawing {name}"))
        try:
            files, caption = make(formats, dpi)
        except MemoryError:
            raise
        except Exception as error:  # one figure never costs the others
            LOGGER.warning("the figure '%s' could not be drawn: %s", name, error, exc_info=True)
            found.append(WrittenFigure(name, "", (), f"{type(error).__name__}: {str(error)[:300]}"))
            continue
        for file, content in files.items():
            write_bytes(folder / file, content)
        found.append(WrittenFigure(name, caption, tuple(files)))
    write_text(folder / CAPTIONS, captions(data, found))
    return tuple(found)


def units_of(data: ReportData, unit: str | None) -> tuple[ModulusUnit, ...]:
    """The units in which moduli are drawn; raises `ConfigurationError` for one in which there are none."""
    if unit is not None:
        return (chosen_unit(data.document, unit),)
    stated = shown_unit(data.document)
    has_ratios = any(item["ratio"] for item in moduli_in(data.document))
    return (stated, shown_unit(data.document, "ratio")) if stated.name == "kPa" and has_ratios else (stated,)


def captions(data: ReportData, figures: Sequence[WrittenFigure]) -> str:
    """The captions of all figures as a text."""
    document = data.document
    version = document.get("versions", {}).get("palpate", "")
    lines = [f"Figures of {document['id']}, drawn by Palpate {version}.", str(document.get("note") or "")]
    for of in figures:
        lines += [f"{', '.join(of.files) or of.name}", of.caption or f"Not drawn: {of.missing}."]
    return "\n\n".join(filter(None, lines)) + "\n"


_Make = Callable[[Sequence[str], int], tuple[dict[str, bytes], str]]


def _drawings(data: ReportData, units: Sequence[ModulusUnit]) -> Iterator[tuple[str, _Make]]:
    """The name of each figure, and what makes its files and its caption for formats and dpi."""

    def of_chart(name: str, chart: Callable[..., str], *arguments: object) -> tuple[str, _Make]:
        """One that is drawn in all formats."""
        return name, lambda formats, dpi: figure_files(name, lambda figure: chart(figure, *arguments), formats, dpi=dpi)

    colours = {tissue.name: tissue.colour for tissue in data.tissues}
    for unit in units:
        yield of_chart(f"moduli-{unit.name.lower()}", moduli_sheet, data.document, colours, unit)
    if data.references:
        yield of_chart("stiffness-slices", stiffness_sheet, data)
    for number, of in enumerate(data.maps, start=1):
        yield of_chart(f"map-{number}", map_sheet, data, of)
    for number, later in enumerate(data.later, start=1):
        yield of_chart(f"before-after-{number}", before_after_sheet, data, later)
        if later.model:
            yield of_chart(f"residuals-{number}", residual_sheet, data, later)
        if later.reference == 0:  # whose mesh is kept
            yield of_chart(f"displacement-{number}", displacement_sheet, data, later)
            yield f"motion-{number}", partial(_animation, data, number)


def map_sheet(figure: Figure, data: ReportData, of: TissueMap) -> str:
    """A map as the page has it, with its caption."""
    map_chart(figure, data, of)
    return (
        f"Map of stiffness inside {data.tissues[of.tissue].name}, in three slices. Left:"
        f" {shown_stiffness(data).label}. Right: the factor by which it may be off (one standard deviation of its"
        " logarithm). Both bars are logarithmic. Hatched: the data removed less than half of what was not known; there"
        f" the mean of the tissue is shown. {of.words}"
    )


def _animation(data: ReportData, number: int, formats: Sequence[str], dpi: int) -> tuple[dict[str, bytes], str]:
    del formats, dpi  # a GIF has its own size
    later = data.later[number - 1]
    return {f"motion-{number}.gif": motion_gif(data, later)}, motion_caption(data, later)


def _refuse(data: ReportData) -> None:
    """Raise `EstimationError` where nothing converged, `InputDataError` for slices that no body has."""
    if data.document["status"] != "converged":
        raise EstimationError(
            f"the estimate ended with the status '{data.document['status']}' ({data.document['reason']}), so there are"
            " no figures: nothing that did not converge is drawn"
        )
    for reference in data.references:
        for box in (reference.slices, reference.whole):
            if box is not None and not (np.all(box.high > box.low) and np.all(box.high - box.low < LARGEST_BOX_MM)):
                raise InputDataError(
                    f"the slices of '{reference.name}' would be {(box.high - box.low).round().tolist()} mm large, which"
                    " no body is: these are not the data of an estimate; run it again"
                )
