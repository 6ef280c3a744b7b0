"""The figures of a result as files for a paper or a talk."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path

from palpate.errors import ConfigurationError, InputDataError
from palpate.images.named_labels import printable
from palpate.progress import Progress, silent
from palpate.report.case_report import data_of
from palpate.report.collect import collect
from palpate.report.figures.every import WrittenFigure, write_figures
from palpate.report.figures.sheet import FORMATS
from palpate.report.report_data import ReportData
from palpate.statement.result import SCHEMA, CaseResult
from palpate.study.earlier import refuse_any_result
from palpate.study.outputs import DATA, RESULT, OutputFolder, read_json

PathLike = str | os.PathLike[str]
DPI = 300
LEAST_DPI, MOST_DPI = 50, 1200


def figures(
    result: CaseResult | PathLike,
    output: PathLike,
    *,
    formats: Sequence[str] = FORMATS,
    unit: str | None = None,
    dpi: int = DPI,
    progress: Progress = silent,
) -> tuple[Path, ...]:
    """Write the figures of a result, or of what an estimate wrote to the folder `result`, into the folder `output`.

    These are moduli with intervals, slices with stiffness, displacement and contours, maps of the surfaces' distances,
    and the motion as GIF, with captions.txt. formats: of "svg", "pdf", "png"; unit: of the moduli, "kPa" or "ratio",
    None: both, where both are known; dpi: dots an inch of pixels; progress: is called with a sentence at each figure.
    Gives the paths that were written, all or none of them. Raises `InputDataError` for a folder that is incomplete or
    was changed since, `EstimationError` for an estimate that did not converge, `ConfigurationError` for a format, a
    unit or dots that cannot be, `ResourceError` where the disk refuses.
    """
    refuse_settings(formats, dpi)
    data = collect(result) if isinstance(result, CaseResult) else read_data(Path(result))
    outputs = OutputFolder(Path(output))
    with outputs.held():
        figures_into(outputs, data, formats=formats, unit=unit, dpi=dpi, progress=progress)
    return tuple(outputs.path / name for name in outputs.written)


def figures_into(
    outputs: OutputFolder,
    data: ReportData,
    *,
    formats: Sequence[str],
    unit: str | None,
    dpi: int,
    progress: Progress = silent,
) -> tuple[WrittenFigure, ...]:
    """Put all figures in place in a folder that this process holds; raises as `figures` does."""
    refuse_any_result(outputs.path)
    with outputs.new_files() as area:
        return write_figures(data, area, formats=formats, unit=unit, dpi=dpi, progress=progress)


def refuse_settings(formats: Sequence[str], dpi: int) -> None:
    """Raise `ConfigurationError` for a format that is not written, or for dots that no figure needs."""
    others = [str(name)[:40] for name in formats if name not in FORMATS]
    if others or not formats:
        raise ConfigurationError(
            f"there is no format '{others[0] if others else ''}' of figures; choose among {', '.join(FORMATS)}"
        )
    if not LEAST_DPI <= dpi <= MOST_DPI:
        raise ConfigurationError(f"{dpi} dots an inch are none that a figure needs: give {LEAST_DPI} to {MOST_DPI}")


def read_data(folder: Path) -> ReportData:
    """What an estimate left in `folder` for its figures.

    Raises `InputDataError` where there is no result of an estimate, or it left no data, or they were changed since.
    """
    path = folder / RESULT
    document = read_json(path)
    if document.get("schema") != SCHEMA:
        schema = printable(str(document.get("schema"))[:40])
        raise InputDataError(f"{path} is no result of an estimate (its schema is '{schema}')")
    files = document.get("files", {})
    if DATA not in files:
        raise InputDataError(
            f"{path} tells of a run that left no {DATA}, from which figures are drawn; run the estimate again with this"
            " version of Palpate"
        )
    return data_of(folder, document=document, sha256=files[DATA]["sha256"])
