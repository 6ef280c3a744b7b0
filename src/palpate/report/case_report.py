"""report.html of one case, one self-contained file, and the data that it can be made from again."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from palpate.case.case import Case
from palpate.errors import InputDataError, PalpateError
from palpate.images.named_labels import printable
from palpate.report.collect import collect, collect_failure
from palpate.report.page import render
from palpate.report.report_data import ReportData
from palpate.statement.result import CaseResult
from palpate.study.earlier import seal_of
from palpate.study.outputs import DATA, PAGE, RESULT, write_text


def write_case_report(result: CaseResult, folder: Path) -> Path:
    """Write report.html and report-data.npz to `folder` and return the page's path.

    A figure that cannot be drawn leaves a sentence in its place. Raises `ResourceError` when the disk refuses.
    """
    return _write(collect(result), folder)


def write_failure_report(case: Case, error: PalpateError, folder: Path) -> Path:
    """Write the same for an estimate that ended in `error`, and return the page's path; raises as above."""
    return _write(collect_failure(case, error), folder)


def redrawn_page(folder: Path, *, document: Mapping[str, Any], sha256: str | None = None, study: bool = False) -> str:
    """The page made again from report-data.npz in `folder`, which must have the SHA-256 that is given.

    document: the result.json beside it; study: whether its sensitivity.html is, too. Raises `InputDataError` when the
    data are missing, damaged, or of another run, when they cannot be drawn, and when the document says other numbers
    than they do.
    """
    data, path = data_of(folder, document=document, sha256=sha256), folder / DATA
    try:
        return render(data, study=study)
    except MemoryError:
        raise
    except Exception as error:  # the page was drawn from them once: they are not what was written then
        raise InputDataError(
            f"{path} holds data of which no page can be made ({type(error).__name__}:"
            f" {printable(str(error)[:200])}); run the estimate again"
        ) from error


def data_of(folder: Path, *, document: Mapping[str, Any], sha256: str | None = None) -> ReportData:
    """What report-data.npz in `folder` holds, which must have the SHA-256 that is given.

    document: the result.json beside it. Raises `InputDataError` when the data are missing, damaged or of another run,
    and when the document says other numbers than they do.
    """
    data = ReportData.load(folder / DATA, sha256=sha256)
    if seal_of(data.document) != seal_of(document):
        raise InputDataError(
            f"the numbers in {folder / RESULT} are not those of the run that wrote {DATA}: one was changed since;"
            " run the estimate again"
        )
    return data


def _write(data: ReportData, folder: Path) -> Path:
    data.save(folder / DATA)
    path = folder / PAGE
    write_text(path, render(data))
    return path
