"""Compute the problems, one after the other; an interrupted run goes on where it was."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

from palpate.errors import PalpateError
from palpate.experiments.verification.page import page
from palpate.experiments.verification.problem import Check, Problem, RowDict, as_row
from palpate.study import software_versions, staged, write_json, write_text

__all__ = ["document_of", "rows_of", "verify"]

SCHEMA = "palpate.verification/1"
UNFINISHED = "verification-unfinished.json"


def verify(problems: Sequence[Problem], folder: Path, *, progress: Callable[[str], None]) -> dict[str, Any]:
    """Compute all problems, write verification.json and verification.md to `folder`, and return the document.

    What is done is kept there after each problem, until all are: a run that was interrupted is taken up again, by the
    same versions of the software only.
    """
    versions = software_versions()
    done: dict[str, list[RowDict]] = {}
    with suppress(OSError, ValueError, KeyError, TypeError):  # no interrupted run, or its file is spoilt
        kept = json.loads((folder / UNFINISHED).read_text(encoding="utf-8"))
        if kept["versions"] == versions:
            done = dict(kept["done"])
    for number, problem in enumerate(problems, start=1):
        if problem.id in done:
            progress(f"{problem.id} ({number} of {len(problems)}): already done")
            continue
        progress(f"{problem.id} ({number} of {len(problems)}): {problem.title}")
        done[problem.id] = rows_of(problem)
        with staged(folder) as staging:
            write_json(staging.area / UNFINISHED, {"versions": versions, "done": done})
            staging.commit()
    document = document_of([row for problem in problems for row in done[problem.id]])
    slow = [problem.id for problem in problems if not problem.quick]
    with staged(folder) as staging:
        write_json(staging.area / "verification.json", document)
        write_text(staging.area / "verification.md", page(document["problems"], slow))
        staging.commit(retired=[UNFINISHED])
    return document


def rows_of(problem: Problem) -> list[RowDict]:
    """The rows of one problem; one that cannot be computed gives a row that has failed, with the reason."""
    try:
        return [as_row(problem, check) for check in problem.measure()]
    except PalpateError as error:
        return [as_row(problem, Check(f"not computed: {error}", 0.0, float("nan"), 0.0, scale=1.0))]


def document_of(rows: list[RowDict]) -> dict[str, Any]:
    """The document of `palpate verify --json`."""
    passed = sum(bool(row["pass"]) for row in rows)
    return {"schema": SCHEMA, "problems": rows, "passed": passed, "failed": len(rows) - passed}
