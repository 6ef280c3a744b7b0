"""report.html of one case, one self-contained file, and the data that it can be made from again."""

from __future__ import annotations

from pathlib import Path

from palpate.errors import PalpateError
from palpate.report.collect import collect, collect_failure
from palpate.report.page import render
from palpate.report.report_data import ReportData
from palpate.study.case import Case
from palpate.study.outputs import write_text
from palpate.study.result import CaseResult

__all__ = ["DATA_NAME", "PAGE_NAME", "rewrite_report", "write_case_report", "write_failure_report"]

PAGE_NAME = "report.html"
DATA_NAME = "report-data.npz"


def write_case_report(result: CaseResult, folder: Path) -> Path:
    """Write report.html and report-data.npz to `folder`, each whole or not at all, and return the page's path.

    A figure that cannot be drawn leaves a sentence in its place. Raises `ResourceError` when the disk refuses.
    """
    return _write(collect(result), folder)


def write_failure_report(case: Case, error: PalpateError, folder: Path) -> Path:
    """Write the same for an estimate that ended in `error`, and return the page's path; raises as above."""
    return _write(collect_failure(case, error), folder)


def rewrite_report(folder: Path) -> Path:
    """Make `folder`/report.html again from the data beside it, and return its path.

    Raises `InputDataError` when report-data.npz is missing or damaged, `ResourceError` when the disk refuses.
    """
    data = ReportData.load(folder / DATA_NAME)
    path = folder / PAGE_NAME
    write_text(path, render(data))
    return path


def _write(data: ReportData, folder: Path) -> Path:
    data.save(folder / DATA_NAME)
    path = folder / PAGE_NAME
    write_text(path, render(data))
    return path
