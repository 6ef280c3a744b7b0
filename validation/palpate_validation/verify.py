"""The problems with known answers: all of them, their table, and its page."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from palpate_validation.problems.beads import BEADS_PROBLEMS
from palpate_validation.problems.concentric import CONCENTRIC_PROBLEMS
from palpate_validation.problems.contract import Problem, rows_of
from palpate_validation.problems.cook import COOK_PROBLEMS
from palpate_validation.problems.estimator import ESTIMATOR_PROBLEMS
from palpate_validation.problems.homogeneous import HOMOGENEOUS_PROBLEMS
from palpate_validation.problems.inclusion import INCLUSION_PROBLEMS
from palpate_validation.problems.indentation import INDENTATION_PROBLEMS
from palpate_validation.problems.inflation import INFLATION_PROBLEMS
from palpate_validation.problems.lame import LAME_PROBLEMS
from palpate_validation.problems.manufactured import MANUFACTURED_PROBLEMS
from palpate_validation.problems.patch import PATCH_PROBLEMS
from palpate_validation.scenes import Job, Part, Progress, Scenes

__all__ = ["PROBLEMS", "Verification", "page", "verification"]

PROBLEMS: tuple[Problem, ...] = (
    *PATCH_PROBLEMS,
    *LAME_PROBLEMS,
    *CONCENTRIC_PROBLEMS,
    *INCLUSION_PROBLEMS,
    *COOK_PROBLEMS,
    *INDENTATION_PROBLEMS,
    *HOMOGENEOUS_PROBLEMS,
    *INFLATION_PROBLEMS,
    *MANUFACTURED_PROBLEMS,
    *ESTIMATOR_PROBLEMS,
    *BEADS_PROBLEMS,
)

SCHEMA = "palpate.verification/1"
HEAD = """# Verification: problems with known answers

`palpate verify --output verification` makes this page, `verification/verification.md`, in some minutes. It ends with
exit code 5 when a check fails. `--quick` leaves out the slow problems (marked *). `--json` prints the numbers. An
interrupted run continues where it stopped. A problem may have several checks. The table has the worst check of each
problem, and the list below it has all checks.

A tolerance is what the discretisation can reach, and does not depend on the result. Exact problems have a tolerance
of round-off. The measured beads (M1) are an exception: their tolerances were chosen to hold. 231 % allows a median
error up to the 95th percentile of the beads' own scatter. At 200 %, three times the median scatter, the neo-Hookean
law would fail. For the Poisson's ratio 0.45 to 0.5 is allowed. So M1 records how far model and measurement differ,
and tests nothing. It compares motions only, because neither the gel's modulus nor the force is known. No number is
published for B7c, so its reference is our own. B7a's 23.96 belongs to the middle of the free side. Some pages ascribe
it to the corner, which moves by 25.1.
"""


@dataclass(frozen=True, slots=True)
class Verification:
    """The rows of all checks, as `palpate verify --json` has them, and the ids of the problems that are slow."""

    rows: tuple[dict[str, Any], ...]
    slow: tuple[str, ...] = ()

    @property
    def failed(self) -> list[str]:
        """Ids of the problems with a check outside of its tolerance."""
        return list(dict.fromkeys(str(row["id"]) for row in self.rows if not row["pass"]))

    def to_dict(self) -> dict[str, Any]:
        """As JSON."""
        passed = sum(bool(row["pass"]) for row in self.rows)
        rows = list(self.rows)
        return {"schema": SCHEMA, "problems": rows, "passed": passed, "failed": len(rows) - passed}

    def text(self) -> list[list[str]]:
        """Rows of cells for a terminal."""
        found = [["id", "quantity", "reference", "ours", "error", "tolerance", ""]]
        for row in self.rows:
            cells = [_number(row[key]) for key in ("reference", "value", "error_percent", "tolerance_percent")]
            ends = [f"{cells[2]} %", f"{cells[3]} %", "ok" if row["pass"] else "FAILED"]
            found.append([row["id"], row["quantity"], *cells[:2], *ends])
        return found


def verification(problems: Sequence[Problem]) -> Scenes[Verification]:
    """The table of these problems; each run computes them all."""
    number = {problem.id: (place, problem) for place, problem in enumerate(problems, start=1)}

    def rows(name: str, progress: Progress) -> Part:
        """The rows of a problem by its id."""
        place, problem = number[name]
        progress(f"{name} ({place} of {len(problems)}): {problem.title}")
        return rows_of(problem)

    def conclude(parts: Mapping[str, Part]) -> Verification:
        """The rows of all."""
        slow = tuple(problem.id for problem in problems if not problem.quick)
        return Verification(tuple(row for name in number for row in parts[name]), slow)

    jobs = [Job((name,), rows) for name in number]
    return Scenes("verification", tuple(number), jobs, conclude, _write_page, ending=".md", again=True)


def _write_page(found: Verification, path: Path) -> None:
    path.write_text(page(found), encoding="utf-8")


def page(found: Verification) -> str:
    """The page (Markdown) with our numbers beside the known ones."""
    rows = found.rows
    ids = list(dict.fromkeys(str(row["id"]) for row in rows))
    verdict = f"failed: {', '.join(found.failed)}" if found.failed else "all within their tolerance"
    lines = [HEAD, f"{len(ids)} problems, {len(rows)} checks: {verdict}.", ""]
    lines += [
        "| id | problem | checks | largest error / tolerance (%) | order | reference |",
        "|---|---|---|---|---|---|",
    ]
    for name in ids:
        own = [row for row in rows if row["id"] == name]
        worst = max(own, key=_share)
        of_both = f"{_number(worst['error_percent'])} / {_number(worst['tolerance_percent'])}"
        orders = ", ".join(f"{row['order']:.2f}" for row in own if row["order"] is not None)
        mark = "*" if name in found.slow else ""
        lines.append(f"| {name}{mark} | {worst['title']} | {len(own)} | {of_both} | {orders} | {worst['source']} |")
    lines += ["", "## All checks", "", "| id | quantity | reference | ours | error (%) | tolerance (%) |"]
    lines.append("|---|---|---|---|---|---|")
    for row in rows:
        cells = [_number(row[key]) for key in ("reference", "value", "error_percent", "tolerance_percent")]
        lines.append(f"| {row['id']} | {row['quantity']} | {' | '.join(cells)} |")
    return "\n".join(lines) + "\n"


def _share(row: dict[str, Any]) -> float:
    """The error over its tolerance."""
    error = math.inf if row["error_percent"] is None else row["error_percent"]
    return float(error / max(row["tolerance_percent"], 1e-12))


def _number(value: float | None) -> str:
    """A number with six digits, or below 1e-6 its order of magnitude."""
    if value is None:
        return "none"
    return f"{value:.1e}" if 0.0 < abs(value) < 1e-6 else f"{value:.6g}"
