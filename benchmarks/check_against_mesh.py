"""Whether cases that pass `palpate check` can be meshed as by `palpate estimate`, and with how many unknowns.

    python benchmarks/check_against_mesh.py [--seeds 0-19] [--edge MM] [--json]

Random pelves with thick slices, thin organs and organs that touch (benchmarks/random_pelves.py) go through `init`,
`check` and the mesher with its gate, without an answer to a question. Nothing is solved. Simulated data.
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

from random_pelves import random_pelvis, write_images

import palpate
from palpate.case import read_case
from palpate.errors import PalpateError

COLUMNS = ("seed", "body", "edge, mm", "`check`", "unknowns: predicted", "found", "`mesh`", "seconds: check", "mesh")


def main() -> int:
    """Exit code 1 where the mesher refuses what `check` passed."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seeds", default="0-19", help="first and last seed")
    parser.add_argument("--edge", type=float, help="mesh.edge_length_mm, instead of what init proposes")
    parser.add_argument("--json", action="store_true", help="print one JSON document")
    arguments = parser.parse_args()
    first, last = map(int, arguments.seeds.split("-"))
    rows = []
    for seed in range(first, last + 1):
        with tempfile.TemporaryDirectory() as folder:
            rows.append(_row(seed, Path(folder), arguments.edge))
        print(_line(rows[-1]), file=sys.stderr, flush=True)
    head = (f"| {' | '.join(COLUMNS)} |", "|" + "---|" * len(COLUMNS))
    print(json.dumps({"runs": rows}, indent=1) if arguments.json else "\n".join([*head, *map(_line, rows)]))
    return int(any(row["check"] == "passed" and row["mesh"] != "meshed" for row in rows))


def _row(seed: int, folder: Path, edge: float | None) -> dict[str, Any]:
    body = random_pelvis(seed)
    before, after, table = write_images(folder, body)
    path = palpate.init(before, after, labels=table, output=folder / "case").path
    overrides = () if edge is None else (f"mesh.edge_length_mm={edge}",)
    clock = [time.perf_counter()]
    report = palpate.check(path, overrides)
    clock.append(time.perf_counter())
    case = read_case(path, overrides)
    row = {"seed": seed, "body": body.what, "edge_mm": case.mesh.edge_length_mm}
    row["check"] = "; ".join(p.message for p in report.problems if p.exit_code) or "passed"
    row["predicted"] = None if report.cost is None else report.cost.unknowns
    try:
        row["found"], row["mesh"] = palpate.make_mesh(case).mesh_summary.dofs, "meshed"
    except PalpateError as error:
        row["found"], row["mesh"] = None, str(error)
    clock.append(time.perf_counter())
    return row | {"seconds": [round(clock[1] - clock[0], 1), round(clock[2] - clock[1], 1)]}


def _line(row: dict[str, Any]) -> str:
    cells = [row["seed"], row["body"], f"{row['edge_mm']:g}", row["check"], row["predicted"], row["found"], row["mesh"]]
    return f"| {' | '.join('-' if cell is None else str(cell) for cell in (*cells, *row['seconds']))} |"


if __name__ == "__main__":
    raise SystemExit(main())
