"""The sub-commands whose outcome is a result with its report: estimate, demo, report."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING

from palpate.cli.console import LOGGER
from palpate.cli.outcome import Outcome, estimates_table, warning_lines
from palpate.errors import ConfigurationError, EstimationError

if TYPE_CHECKING:
    from palpate.study.case import Case
    from palpate.study.result import CaseResult

__all__ = ["demo", "estimate", "report"]

Progress = Callable[[str], None]


def estimate(arguments: argparse.Namespace, case: Case | None, progress: Progress) -> Outcome:
    """Estimate a case, or images for which a case is written first."""
    from palpate.study import run

    if case is not None and arguments.labels is not None:
        raise ConfigurationError("--labels goes with images; a case names its label table itself, as [images] names")
    case = case or _case_of_images(arguments, progress)
    try:
        result = run.estimate(case, progress=progress)
    except EstimationError as error:
        return _estimation_failed(case, error, arguments.output)
    return _write_estimate(result, arguments.output, progress)


def demo(arguments: argparse.Namespace, _: None, progress: Progress) -> Outcome:
    """The whole way on the pelvis that Palpate brings along."""
    from palpate.experiments.demo import run_demo

    return _write_estimate(run_demo(arguments.output, progress), arguments.output, progress)


def report(arguments: argparse.Namespace, _: None, progress: Progress) -> Outcome:
    """Draw the page of an estimate again from the data that it left in its output folder."""
    from palpate.report.case_report import rewrite_report
    from palpate.study.outputs import read_json, strange_files

    folder: Path = arguments.folder
    progress("drawing the report")
    path = rewrite_report(folder)
    result = read_json(folder / "result.json")
    strange = strange_files(folder, result.get("files", {}))
    text = "".join(f"warning: {folder / name} is not of the run that result.json tells of\n" for name in strange)
    document = {"schema": "palpate.report/1", "id": result.get("id"), "report": str(path), "strange_files": strange}
    return Outcome(document, f"{text}written to {path}")


def _case_of_images(arguments: argparse.Namespace, progress: Progress) -> Case:
    """Write a case for images into the output folder, say who is taken for what, and read it."""
    from palpate.study.case_file import read_case
    from palpate.study.new_case import write_new_case

    path, case = write_new_case(arguments.inputs, arguments.labels, arguments.output)
    for tissue in case.tissues:
        progress(f"{tissue.name}: {tissue.role or '?'}, for {tissue.reason}")
    progress(f"the case is written to {path}")
    return read_case(path, arguments.set)


def _write_estimate(result: CaseResult, folder: Path, progress: Progress) -> Outcome:
    """Write all outputs of an estimate, result.json last: where it is, the others are whole."""
    from palpate.export.case_files import write_estimate_files
    from palpate.study.outputs import digests, write_json

    progress("writing mesh and stiffness map")
    document = result.to_dict()
    document["files"] = digests(write_estimate_files(result, folder))
    progress("drawing the report")
    document["warnings"] += _earlier_files(folder, document["files"])
    document["warnings"] += _write_report(lambda: _case_report(result, folder))
    write_json(folder / "result.json", document)
    converged = document["status"] == "converged"
    files = ", ".join(("result.json", "report.html", *document["files"], "log.txt"))
    text = f"{estimates_table(document)}\n{warning_lines(document)}written to {folder}: {files}"
    complaint = "" if converged else f"{document['status']}: {document['reason']}"
    return Outcome(document, text, 0 if converged else EstimationError.exit_code, complaint)


def _estimation_failed(case: Case, error: EstimationError, folder: Path) -> Outcome:
    """A result file that says that there is no result, and which files in the folder are not of this run."""
    from palpate.study.outputs import write_json
    from palpate.study.result import failure_document

    LOGGER.error("%s", error, exc_info=error)
    document = failure_document(case, error)
    document["files"] = {}
    document["warnings"] += _earlier_files(folder, {})
    document["warnings"] += _write_report(lambda: _failure_report(case, error, folder))
    write_json(folder / "result.json", document)
    return Outcome(document, "", error.exit_code, str(error))


def _earlier_files(folder: Path, files: Mapping[str, Mapping[str, str]]) -> list[dict[str, str]]:
    """A warning on what other programs could take for a file of this run, whose own are `files`."""
    from palpate.study.outputs import strange_files

    stale = strange_files(folder, files)
    message = f"{', '.join(stale)} in the output folder are of an earlier run and do not belong to this result"
    return [{"code": "earlier-files", "message": message}] if stale else []


def _case_report(result: CaseResult, folder: Path) -> Path:
    from palpate.report.case_report import write_case_report

    return write_case_report(result, folder)


def _failure_report(case: Case, error: EstimationError, folder: Path) -> Path:
    from palpate.report.case_report import write_failure_report

    return write_failure_report(case, error, folder)


def _write_report(write: Callable[[], Path]) -> list[dict[str, str]]:
    """Warnings on a report that could not be written; a drawing never costs the estimate."""
    try:
        write()
    except Exception as error:
        LOGGER.exception("the report could not be written")
        return [{"code": "report", "message": f"report.html could not be written ({error}); the numbers are unharmed"}]
    return []
