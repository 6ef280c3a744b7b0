"""How the mesh changes cost and result: the same images estimated on meshes of several edge lengths.

    python benchmarks/edge_length.py [--row clean] [--cases 4] [--first-seed 601] [--edges 4,5,6,8] [--meshes 1]
                                     [--output FILE] [--json]

Simulated pelves of a row of accuracy.py. For each edge length it gives the unknowns, the error of ln E, and the
distance from the estimate of the first edge length as a share of the 95 % interval (without the position of the
voxels). `--meshes` makes several meshes of each edge length, which differ by a few per cent. Then it gives the root
mean square distance of a body's estimates from the mean of the first edge length, and the stated standard deviation
(`discretisation_sd`). Each estimate is a line of JSON in FILE; another run with the same file adds to it.
"""

from __future__ import annotations

import argparse
import json
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from accuracy import true_ratios
from accuracy_rows import ROWS, Truths, posed

from palpate.inversion import invert
from palpate.uncertainty import NORMAL_95, discretisation_sd, sandwich_covariance

OTHER_MESH = 0.03  # by which share of its edge length a further mesh of the same edge length differs


def main() -> int:
    """Run what was asked for and print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--row", default="clean", choices=[name for name, row in ROWS.items() if row.data == "voxels"])
    parser.add_argument("--cases", type=int, default=4)
    parser.add_argument("--first-seed", type=int, default=601)
    parser.add_argument("--edges", default="4,5,6,8")
    parser.add_argument("--meshes", type=int, default=1)
    parser.add_argument("--output", type=Path, default=Path("edge_length.jsonl"))
    parser.add_argument("--json", action="store_true", help="print one JSON document")
    asked = parser.parse_args()
    edges = [float(edge) for edge in asked.edges.split(",")]
    lines = asked.output.read_text().splitlines() if asked.output.exists() else []
    kept = {(row["row"], row["seed"], row["edge_mm"], row["mesh"]): row for row in map(json.loads, lines)}
    found = []
    for seed in range(asked.first_seed, asked.first_seed + asked.cases):
        truths: Truths = {}
        for edge, mesh in ((edge, mesh) for edge in edges for mesh in range(asked.meshes)):
            row = kept.get((asked.row, seed, edge, mesh))
            if row is None:
                row = _estimated(asked.row, seed, edge, mesh, truths)
                with asked.output.open("a") as file:
                    file.write(json.dumps(row) + "\n")
                print(json.dumps(row), file=sys.stderr, flush=True)
            found.append(row)
    rows = [_summary(edge, found, edges[0]) for edge in edges]
    document: dict[str, Any] = {"edges": rows}
    if asked.meshes > 1:
        document["discretisation"] = _stated_beside_found(found, edges[0])
    print(json.dumps(document, indent=1) if asked.json else _table(document))
    return 0


def _estimated(name: str, seed: int, edge_mm: float, mesh: int, truths: Truths) -> dict[str, Any]:
    """Error, standard deviation of the noise and that of the mesh, of ln E of every organ."""
    away = OTHER_MESH * ((mesh + 1) // 2) * (-1) ** mesh
    case = posed(replace(ROWS[name], edge_mm=edge_mm * (1.0 + away)), seed, 0, truths)
    inversion = invert(case.problem, case.settings, progress=lambda _: None)
    objective, minimum = inversion.objective, inversion.minimum
    error = minimum.unknowns[: objective.n_parameters] - np.log(true_ratios(objective, case.scene))
    sd = np.sqrt(np.diag(sandwich_covariance(objective, minimum.evaluation)))
    organs = [[case.space.mesh.tissue_index(tissue)] for tissue in objective.parameters.tissues]
    return {
        "row": name,
        "seed": seed,
        "edge_mm": edge_mm,
        "mesh": mesh,
        "unknowns": 3 * len(case.space.points),
        "converged": minimum.converged,
        "error": error.tolist(),
        "sd": sd.tolist(),
        "mesh_sd": [discretisation_sd(case.space, organ) for organ in organs],
    }


def _summary(edge_mm: float, found: list[dict[str, Any]], first_mm: float) -> dict[str, Any]:
    rows = [row for row in found if row["edge_mm"] == edge_mm]
    first = _first(found, first_mm)
    errors = np.concatenate([row["error"] for row in rows])
    off = [np.abs(row["error"] - first[row["seed"]]) / (2.0 * NORMAL_95 * np.array(row["sd"])) for row in rows]
    return {
        "edge_mm": edge_mm,
        "unknowns": round(float(np.mean([row["unknowns"] for row in rows]))),
        "rms_ln_error": float(np.sqrt(np.mean(errors**2))),
        "share_of_interval": float(np.median(off)),
        "largest_share": float(np.max(off)),
    }


def _first(found: list[dict[str, Any]], first_mm: float) -> dict[int, Any]:
    """Mean error of each body over the meshes of the first edge length."""
    of: dict[int, list[list[float]]] = {row["seed"]: [] for row in found}
    for row in found:
        if row["edge_mm"] == first_mm:
            of[row["seed"]].append(row["error"])
    return {seed: np.mean(errors, axis=0) for seed, errors in of.items()}


def _stated_beside_found(found: list[dict[str, Any]], first_mm: float) -> dict[str, Any]:
    """For each body and edge length, root mean squares over meshes and organs: found deviation and stated one."""
    first, cases = _first(found, first_mm), []
    for key in dict.fromkeys((row["seed"], row["edge_mm"]) for row in found if row["edge_mm"] != first_mm):
        rows = [row for row in found if (row["seed"], row["edge_mm"]) == key]
        off = np.sqrt(np.mean([np.square(row["error"] - first[key[0]]) for row in rows]))
        stated = np.sqrt(np.mean([np.square(row["mesh_sd"]) for row in rows]))
        cases.append({"seed": key[0], "edge_mm": key[1], "found": float(off), "stated": float(stated)})
    ratios = np.array([case["stated"] / case["found"] for case in cases])
    within = int(np.sum((ratios >= 0.5) & (ratios <= 2.0)))
    return {"cases": cases, "within_a_factor_2": within, "median_ratio": float(np.median(ratios))}


def _table(document: dict[str, Any]) -> str:
    lines = ["| edge, mm | unknowns | RMS ln-error | off the first, of the interval | most |", "|---|---|---|---|---|"]
    lines += [
        f"| {row['edge_mm']:g} | {row['unknowns']} | {row['rms_ln_error']:.3f} | {row['share_of_interval']:.0%} |"
        f" {row['largest_share']:.0%} |"
        for row in document["edges"]
    ]
    if "discretisation" in document:
        cases, within = (document["discretisation"][name] for name in ("cases", "within_a_factor_2"))
        lines += [f"seed {c['seed']}, {c['edge_mm']:g} mm: {c['found']:.4f}, stated {c['stated']:.4f}" for c in cases]
        lines += [f"within a factor 2: {within} of {len(cases)};"]
        lines[-1] += f" median of stated / found {document['discretisation']['median_ratio']:.2f}"
    return "\n".join(lines)


if __name__ == "__main__":
    raise SystemExit(main())
