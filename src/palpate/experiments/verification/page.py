"""The page of the documentation that holds our numbers beside the known ones."""

from __future__ import annotations

import math
from collections.abc import Sequence

from palpate.experiments.verification.problem import RowDict

__all__ = ["page"]

HEAD = """# Verification: problems with known answers

Made by `palpate verify --output verification`, which computes everything below in some minutes, writes this page as
`verification/verification.md` (copy it to `docs/`) and ends with exit code 5 when one check fails. `--quick` leaves out
the slow ones (marked *), which are also left out by continuous integration; `--json` prints the numbers; a run that was
interrupted goes on where it was. A problem may have several checks: the table has the worst of each, and the list below
it has them all.

A tolerance is what the discretisation can reach and does not depend on the result; exact problems are held to
round-off. The two of the measured beads (M1) are exceptions: both are chosen to hold. 231 % is a typical error no
larger than the 95th percentile of the beads' own scatter (at 200 %, three times its median, the neo-Hookean law would
miss), and 0.45 to 0.5 for the Poisson's ratio is wide enough for the one that fits. So M1 records how far model and
measurement are apart and tests nothing. It compares motions only: neither the gel's modulus nor the force is known. The
reference of B7c is ours, for no number is published. B7a's 23.96 belongs to the middle of the free side; the corner, to
which some pages ascribe it, moves by 25.1.
"""


def page(rows: Sequence[RowDict], slow: Sequence[str] = ()) -> str:
    """The page (Markdown) of all rows; `slow`: ids of the problems that are not computed quickly."""
    ids = list(dict.fromkeys(str(row["id"]) for row in rows))
    failed = [str(row["id"]) for row in rows if not row["pass"]]
    verdict = f"failed: {', '.join(dict.fromkeys(failed))}" if failed else "all within their tolerance"
    lines = [HEAD, f"{len(ids)} problems, {len(rows)} checks: {verdict}.", ""]
    lines += [
        "| id | problem | checks | largest error / tolerance (%) | order | reference |",
        "|---|---|---|---|---|---|",
    ]
    for name in ids:
        own = [row for row in rows if row["id"] == name]
        errors = [math.inf if row["error_percent"] is None else row["error_percent"] for row in own]
        shares = [error / max(row["tolerance_percent"], 1e-12) for error, row in zip(errors, own, strict=True)]
        worst = own[shares.index(max(shares))]
        of_both = f"{_number(worst['error_percent'])} / {_number(worst['tolerance_percent'])}"
        orders = ", ".join(f"{row['order']:.2f}" for row in own if row["order"] is not None)
        mark = "*" if name in slow else ""
        lines.append(f"| {name}{mark} | {worst['title']} | {len(own)} | {of_both} | {orders} | {worst['source']} |")
    lines += ["", "## All checks", "", "| id | quantity | reference | ours | error (%) | tolerance (%) |"]
    lines.append("|---|---|---|---|---|---|")
    for row in rows:
        cells = [_number(row[key]) for key in ("reference", "value", "error_percent", "tolerance_percent")]
        lines.append(f"| {row['id']} | {row['quantity']} | {' | '.join(cells)} |")
    return "\n".join(lines) + "\n"


def _number(value: float | None) -> str:
    """Six digits; what is only round-off is told by its size."""
    if value is None:
        return "none"
    return f"{value:.1e}" if 0.0 < abs(value) < 1e-6 else f"{value:.6g}"
