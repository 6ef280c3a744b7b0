"""The files of an estimate put in place together: numbers, page, mesh and case, all or none."""

from __future__ import annotations

import logging
from collections.abc import Callable
from pathlib import Path
from typing import Any

from palpate import report
from palpate.errors import EstimationError, InputDataError, ResourceError
from palpate.export.case_files import write_estimate_files
from palpate.findings import Finding, warning_rows
from palpate.progress import Line, Progress, silent
from palpate.study.case import Case
from palpate.study.earlier import earlier_files, stage_case, vouched
from palpate.study.outputs import DATA, PAGE, RESULT, OutputFolder, Staging, read_json, write_json, write_text
from palpate.study.result import CaseResult, failure_document
from palpate.study.sensitivity import Sensitivity

LOGGER = logging.getLogger(__name__)
STUDY = "sensitivity.json"


def save_estimate(result: CaseResult, outputs: OutputFolder, *, progress: Progress = silent) -> dict[str, Any]:
    """Put all files of an estimate in place in a folder that this process holds; gives the document result.json.

    Where the page cannot be made, a warning of the document says so instead. Raises `ResourceError` where the disk
    refuses.
    """
    progress(Line("writing the results and the report"))
    document = result.to_dict()
    with outputs.staged() as staging:
        write_estimate_files(result, staging.area)
        _draw(lambda: report.write_case_report(result, staging.area), staging, document)
        _commit_estimate(staging, result.whole_case, document)
    return document


def save_failure(case: Case, error: EstimationError, outputs: OutputFolder) -> dict[str, Any]:
    """The same for an estimate without a result: a document that says so, and which files are not of this run."""
    LOGGER.error("%s", error, exc_info=error)
    document = failure_document(case, error)
    with outputs.staged() as staging:
        _draw(lambda: report.write_failure_report(case, error, staging.area), staging, document)
        _commit_estimate(staging, case, document)
    return document


def save_sensitivity(found: Sensitivity, outputs: OutputFolder) -> dict[str, Any]:
    """Put sensitivity.json and sensitivity.html in place; gives the document. Raises `ResourceError`."""
    document = found.to_dict()
    with outputs.staged() as staging:
        write_text(staging.area / "sensitivity.html", report.sensitivity_page(document))
        save_document(staging, STUDY, document)
    if has_study(outputs.path) and {PAGE, DATA} <= set(vouched(outputs.path, RESULT)):
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
    with outputs.staged() as staging:
        write_text(staging.area / PAGE, page)
        files |= staging.digests()
        write_json(staging.area / RESULT, result)
        staging.commit()
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


def save_document(staging: Staging, name: str, document: dict[str, Any]) -> None:
    """Put the staged files in place with the document that lists them; those of the document before it go with that."""
    document["files"] = staging.digests()
    earlier = earlier_files(staging.folder, name, document["files"])
    document["warnings"] = warning_rows(earlier.warnings, beside=document["warnings"])
    write_json(staging.area / name, document)
    staging.commit(retired=earlier.retired, aside=earlier.aside)


def _commit_estimate(staging: Staging, case: Case, document: dict[str, Any]) -> None:
    """All files with the case as it was run; where space is short for all, without the page."""
    own = warning_rows(stage_case(case, staging), beside=document["warnings"])
    while True:
        document["warnings"] = own
        try:
            return save_document(staging, RESULT, document)
        except ResourceError as error:
            if PAGE not in document["files"] or staging.unfinished:
                raise
            LOGGER.warning("the report is left out: %s", error)
            own = warning_rows([_no_report(error)], beside=own)
            staging.discard(PAGE, DATA, RESULT)


def _draw(write: Callable[[], Path], staging: Staging, document: dict[str, Any]) -> None:
    """Make page and data, both or none; a drawing never costs the estimate."""
    try:
        write()
    except Exception as error:
        LOGGER.exception("the report could not be written")
        staging.discard(PAGE, DATA)
        document["warnings"] = warning_rows([_no_report(error)], beside=document["warnings"])


def _no_report(error: Exception) -> Finding:
    return Finding("report", f"{PAGE} could not be written ({error}); the numbers are unharmed.")
