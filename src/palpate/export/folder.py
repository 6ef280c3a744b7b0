"""From a result, or the folder that it was written to, to files for another program."""

from __future__ import annotations

import os
from pathlib import Path

from palpate.export.fitted_model import FittedModel, fitted_model
from palpate.export.formats import Options, format_named
from palpate.export.model_file import read_model
from palpate.statement.result import CaseResult
from palpate.study.earlier import refuse_any_result, seal_of
from palpate.study.outputs import OutputFolder, make_folder

PathLike = str | os.PathLike[str]


def export(
    result: CaseResult | PathLike,
    output: PathLike,
    *,
    format: str,  # noqa: A002 - the flag's own name
    linear: bool = False,
    source: PathLike | None = None,
) -> tuple[Path, ...]:
    """Write a result, or what an estimate wrote to the folder `result`, into `output` for another program.

    format: one of `palpate.export.formats.FORMATS`; linear: tetrahedra of four nodes, displacements of corners alone;
    source: a folder with the DICOM series of the first image, which "dicom" refers to. Gives the paths that were
    written, all or none of them. Raises `InputDataError` for a folder that is incomplete, of another version or changed
    since, `EstimationError` for an estimate that did not converge, `ConfigurationError` for an unknown format or an
    `output` that holds a result, `ResourceError` where a library is missing or the disk refuses.
    """
    options = Options(linear, None if source is None else Path(source))
    format_named(format)
    if isinstance(result, CaseResult):
        model = fitted_model(result, seal=seal_of(result.to_dict()))
    else:
        model = read_model(Path(result))
    outputs = OutputFolder(Path(output))
    with outputs.held():
        export_into(outputs, model, format, options)
    return tuple(outputs.path / name for name in outputs.written)


def export_into(outputs: OutputFolder, model: FittedModel, name: str, options: Options) -> None:
    """Put the files of the format `name` in place in a folder that is held; further pairs' in pair_2, pair_3 ..."""
    form = format_named(name)
    refuse_any_result(outputs.path)
    with outputs.new_files() as area:
        for number, body in enumerate(model.bodies if form.every_pair else model.bodies[:1], start=1):
            folder = area if number == 1 else make_folder(area / f"pair_{number}")
            source = (options.source,) if form.refers else ()
            form.write(model, body.with_linear_tetrahedra() if options.linear else body, folder, *source)
