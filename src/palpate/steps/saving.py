"""The files of an estimate put in place together: numbers, page, mesh and case, all or none."""

from __future__ import annotations

import html
import logging
from collections.abc import Callable
from pathlib import Path
from typing import Any

from palpate import report
from palpate.case.case import Case
from palpate.errors import EstimationError, InputDataError
from palpate.export.case_files import write_estimate_files
from palpate.findings import Finding, warning_rows
from palpate.progress import Line, Progress, silent
from palpate.statement.result import CaseResult, failure_document
from palpate.study.earlier import earlier_files, write_case
from palpate.study.outputs import (
    DATA,
    PAGE,
    RESULT,
    OutputFolder,
    digests_of,
    read_json,
    vouched,
    write_json,
    write_text,
)
from palpate.study.sensitivity import Sensitivity

LOGGER = logging.getLogger(__name__)
STUDY = "sensitivity.json"


def save_estimate(result: CaseResult, outputs: OutputFolder, *, progress: Progress = silent) -> dict[str, Any]:
    """Put all files of an estimate in place in a folder that this process holds; gives the document result.json.

    Where the page cannot be made, a warning and another page say so instead. Raises `ResourceError` where the disk
    refuses.
    """
    progress(Line("writing the results and the report"))
    document = result.to_dict()
    with outputs.new_files() as area:
        write_estimate_files(result, area)
        _draw(lambda: report.write_case_report(result, area), area, document)
        _write_estimate(result.whole_case, document, outputs, area)
    return document


def save_failure(case: Case, error: EstimationError, outputs: OutputFolder) -> dict[str, Any]:
    """The same for an estimate without a result: a document that says so, and which files are not of this run."""
    LOGGER.error("%s", error, exc_info=error)
    document = failure_document(case, error)
    with outputs.new_files() as area:
        _draw(lambda: report.write_failure_report(case, error, area), area, document)
        _write_estimate(case, document, outputs, area)
    return document


def save_sensitivity(found: Sensitivity, outputs: OutputFolder) -> dict[str, Any]:
    """Put sensitivity.json and sensitivity.html in place; gives the document. Raises `ResourceError`."""
    document = found.to_dict()
    with outputs.new_files() as area:
        write_text(area / "sensitivity.html", report.sensitivity_page(document))
        write_document(document, STUDY, outputs, area)
    if has_study(outputs.path) and {PAGE, DATA} <= vouched(outputs.path, RESULT):
        try:
            redraw_page(outputs)  # which links to the study from now on
        except InputDataError as error:  # the study stands without it
            LOGGER.warning("the report beside the study is left as it is: %s", error)
    return document


def redraw_page(outputs: OutputFolder) -> dict[str, Any]:
    """Draw report.html of an estimate again from the data in its folder; gives the document result.json.

    Raises `InputDataError` as `redrawn_page` does, and where the run left no data.
    """
    result = read_json(outputs.path / RESULT)
    files = result.setdefault("files", {})
    if DATA not in files:
        raise InputDataError(f"{outputs.path / RESULT} tells of a run without {DATA}; run the estimate again")
    study = has_study(outputs.path)
    page = report.redrawn_page(outputs.path, document=result, sha256=files[DATA]["sha256"], study=study)
    with outputs.new_files() as area:
        write_text(area / PAGE, page)
        files |= digests_of(area)
        write_json(area / RESULT, result)
    return result


def has_study(folder: Path) -> bool:
    """Whether the sensitivity study in a folder is that of its estimate: both begin with the same moduli."""
    try:
        study, result = read_json(folder / STUDY), read_json(folder / RESULT)
        named = [[(item["tissue"], item["value"], item["ratio"]) for item in of["estimates"]] for of in (study, result)]
    except (InputDataError, KeyError, TypeError):
        return False
    same = all(one in named[1] for one in named[0])
    return bool(named[0]) and same and "sensitivity.html" in vouched(folder, STUDY)


def write_document(document: dict[str, Any], name: str, outputs: OutputFolder, area: Path) -> None:
    """Write the document that lists the new files in `area`, with warnings on what an earlier run has left."""
    document["files"] = digests_of(area)
    earlier = earlier_files(outputs.path, name, document["files"])
    document["warnings"] = warning_rows(earlier, beside=document["warnings"])
    write_json(area / name, document)


def _write_estimate(case: Case, document: dict[str, Any], outputs: OutputFolder, area: Path) -> None:
    """The case as it was run, and the document."""
    document["warnings"] = warning_rows(write_case(case, outputs, area), beside=document["warnings"])
    write_document(document, RESULT, outputs, area)


def _draw(write: Callable[[], Path], area: Path, document: dict[str, Any]) -> None:
    """Make page and data, or a page that says why there is none; a drawing never costs the estimate."""
    try:
        write()
    except Exception as error:
        LOGGER.exception("the report could not be drawn")
        finding = Finding("report", f"{PAGE} could not be drawn ({error}); the numbers are unharmed.")
        document["warnings"] = warning_rows([finding], beside=document["warnings"])
        (area / DATA).unlink(missing_ok=True)
        shown = html.escape(f"{document['id']}: {finding.message}")
        write_text(area / PAGE, f"<!doctype html><meta charset=utf-8><title>Palpate</title><p>{shown}\n")
