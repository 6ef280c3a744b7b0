"""What the mesh costs and changes: the same images estimated on meshes of several edge lengths.

    python benchmarks/edge_length.py [--row clean] [--cases 4] [--first-seed 601] [--edges 4,5,6,8] [--json]

Simulated pelves of a row of accuracy.py. For each edge length: unknowns, the error of ln E, and by which share of the
95 % interval (of the residuals' noise, the voxels' place left out) the estimate lies off that of the first edge length.
"""

from __future__ import annotations

import argparse
import json
import sys
from dataclasses import replace
from typing import Any

import numpy as np
from accuracy import true_ratios
from accuracy_rows import ROWS, Truths, posed

from palpate.inversion import invert
from palpate.uncertainty import NORMAL_95, sandwich_covariance


def main() -> int:
    """Run what was asked for and print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--row", default="clean", choices=[name for name, row in ROWS.items() if row.data == "voxels"])
    parser.add_argument("--cases", type=int, default=4)
    parser.add_argument("--first-seed", type=int, default=601)
    parser.add_argument("--edges", default="4,5,6,8")
    parser.add_argument("--json", action="store_true", help="print one JSON document")
    asked = parser.parse_args()
    edges = [float(edge) for edge in asked.edges.split(",")]
    found = []
    for seed in range(asked.first_seed, asked.first_seed + asked.cases):
        truths: Truths = {}
        for edge in edges:
            found.append(_estimated(asked.row, seed, edge, truths))
            print(json.dumps(found[-1]), file=sys.stderr, flush=True)
    rows = [_summary(edge, found, edges[0]) for edge in edges]
    print(json.dumps(rows, indent=1) if asked.json else _table(rows))
    return 0


def _estimated(name: str, seed: int, edge_mm: float, truths: Truths) -> dict[str, Any]:
    """Error and standard deviation of ln E of every organ."""
    case = posed(replace(ROWS[name], edge_mm=edge_mm), seed, 0, truths)
    inversion = invert(case.problem, case.settings, progress=lambda _: None)
    objective, minimum = inversion.objective, inversion.minimum
    error = minimum.unknowns[: objective.n_parameters] - np.log(true_ratios(objective, case.scene))
    sd = np.sqrt(np.diag(sandwich_covariance(objective, minimum.evaluation)))
    return {
        "seed": seed,
        "edge_mm": edge_mm,
        "unknowns": 3 * len(case.space.points),
        "converged": minimum.converged,
        "error": error.tolist(),
        "sd": sd.tolist(),
    }


def _summary(edge_mm: float, found: list[dict[str, Any]], first_mm: float) -> dict[str, Any]:
    rows = [row for row in found if row["edge_mm"] == edge_mm]
    first = {row["seed"]: row for row in found if row["edge_mm"] == first_mm}
    errors = np.concatenate([row["error"] for row in rows])
    off = [
        np.abs(np.subtract(row["error"], first[row["seed"]]["error"])) / (2.0 * NORMAL_95 * np.array(row["sd"]))
        for row in rows
    ]
    return {
        "edge_mm": edge_mm,
        "unknowns": round(float(np.mean([row["unknowns"] for row in rows]))),
        "rms_ln_error": float(np.sqrt(np.mean(errors**2))),
        "share_of_interval": float(np.median(off)),
        "largest_share": float(np.max(off)),
    }


def _table(rows: list[dict[str, Any]]) -> str:
    lines = ["| edge, mm | unknowns | RMS ln-error | off the first, of the interval | most |", "|---|---|---|---|---|"]
    lines += [
        f"| {row['edge_mm']:g} | {row['unknowns']} | {row['rms_ln_error']:.3f} | {row['share_of_interval']:.0%} |"
        f" {row['largest_share']:.0%} |"
        for row in rows
    ]
    return "\n".join(lines)


if __name__ == "__main__":
    raise SystemExit(main())
