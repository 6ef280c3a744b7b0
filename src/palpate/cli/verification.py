"""The sub-command verify: our numbers beside the known ones."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from typing import TYPE_CHECKING

from palpate.cli.outcome import Outcome, columns
from palpate.errors import EstimationError

if TYPE_CHECKING:
    from palpate.study.outputs import OutputFolder

__all__ = ["verify"]

Progress = Callable[[str], None]


def verify(arguments: argparse.Namespace, _: None, outputs: OutputFolder, progress: Progress) -> Outcome:
    """Compute the problems with known answers and hold our numbers beside them."""
    from palpate.experiments.verification.registry import PROBLEMS
    from palpate.experiments.verification.run import verify as compute

    problems = [problem for problem in PROBLEMS if problem.quick or not arguments.quick]
    document = compute(problems, outputs.path, progress=progress)
    rows = [["id", "quantity", "reference", "ours", "error", "tolerance", ""]]
    for row in document["problems"]:
        numbers = [_cell(row[key]) for key in ("reference", "value", "error_percent", "tolerance_percent")]
        rows.append(
            [
                row["id"],
                row["quantity"],
                *numbers[:2],
                f"{numbers[2]} %",
                f"{numbers[3]} %",
                "ok" if row["pass"] else "FAILED",
            ]
        )
    failed = sorted({row["id"] for row in document["problems"] if not row["pass"]})
    text = f"{columns(rows)}\n{document['passed']} checks passed, {document['failed']} failed\n"
    files = "verification.json, verification.md"
    complaint = f"outside of their tolerance: {', '.join(failed)}" if failed else ""
    code = EstimationError.exit_code if failed else 0
    return Outcome(document, f"{text}written to {outputs.path}: {files}", code, complaint)


def _cell(value: float | None) -> str:
    return "–" if value is None else f"{value:.6g}" if value == 0.0 or abs(value) > 1e-6 else f"{value:.1e}"
