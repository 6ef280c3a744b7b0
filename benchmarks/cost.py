"""What `palpate check` predicts that an estimate will cost, beside what it costs: tetrahedra, seconds, memory.

    python benchmarks/cost.py [--cases N,N,...] [--json]

Each case runs in a process of its own, from label images on disk, so that its peak memory is its own. The constants of
`palpate.study.cost` are fitted to these runs. Simulated data.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from memory import peak_mb

from palpate.experiments.simulated_pelvis import DATA
from palpate.images import Role, write_label_image
from palpate.phantoms import PelvisOptions, Scene, SpheresOptions, pelvis, spheres
from palpate.study import estimate, expected_cost, read_case, read_states


@dataclass(frozen=True)
class Run:
    """One case: the body, what it is computed with, and whether the constants were fitted to it."""

    body: str
    edge_mm: float
    modes: int = 90
    law: str = "linear"
    element: str = "auto"
    solver: str = "auto"
    fitted: bool = True


RUNS = (
    Run("spheres", 8.0, modes=30),
    Run("spheres", 6.0),
    Run("pelvis", 8.0),
    Run("pelvis", 8.0, element="P1"),
    Run("pelvis", 6.0),
    Run("demo", 10.0),
    Run("pelvis", 8.0, law="neo-hookean"),
    Run("pelvis", 5.5, law="neo-hookean"),
    Run("demo", 8.0, fitted=False),
    Run("pelvis", 6.5, law="neo-hookean", fitted=False),
)
CASE = """
[images]
before = "before.nii.gz"
after = ["after.nii.gz"]
[tissues]
surroundings = {label = "remaining", role = "known", youngs_modulus_kpa = 10.0}
"""


def main() -> int:
    """Run the cases that were asked for and print what was predicted and found."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--cases", default=",".join(str(i) for i in range(len(RUNS))), help="numbers, from 0")
    parser.add_argument("--json", action="store_true", help="print one JSON document")
    parser.add_argument("--one", nargs=2, help=argparse.SUPPRESS)
    parser.add_argument("--images", help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.images:
        _write_images(Path(arguments.images))
        return 0
    if arguments.one:
        print(json.dumps(_one(RUNS[int(arguments.one[0])], Path(arguments.one[1]))))
        return 0
    rows = []
    with tempfile.TemporaryDirectory() as folder:
        _child("--images", folder)
        for number in arguments.cases.split(","):
            rows.append(json.loads(_child("--one", number, folder)))
            print(_line(rows[-1]), file=sys.stderr, flush=True)
    print(json.dumps({"runs": rows}, indent=1) if arguments.json else "\n".join([*HEAD, *(_line(row) for row in rows)]))
    return 0


def _child(*arguments: str) -> str:
    command = [sys.executable, str(Path(__file__)), *arguments]
    return subprocess.run(command, check=True, stdout=subprocess.PIPE, text=True).stdout


def _write_images(folder: Path) -> None:
    """The label images of both phantoms, whose truths need more memory than their estimates."""
    scenes = {
        "spheres": spheres(SpheresOptions(seed=2, truth_edge_mm=5.0)),
        "pelvis": pelvis(PelvisOptions(seed=1, truth_edge_mm=4.0)),
    }
    for name, scene in scenes.items():
        (folder / name).mkdir()
        write_case(folder / name, scene)


def write_case(folder: Path, scene: Scene) -> None:
    """A scene's images and a case of them, as a user has them."""
    write_label_image(folder / "before.nii.gz", scene.before)
    write_label_image(folder / "after.nii.gz", scene.after)
    seen = [t for t in scene.tissues if t.role in (Role.ESTIMATE, Role.DRIVER)]
    lines = [f'{t.name} = {{label = {t.labels[0]}, role = "{t.role.value}"}}' for t in seen]
    (folder / "case.toml").write_text(CASE + "\n".join(lines))


def _one(run: Run, folder: Path) -> dict[str, object]:
    path = DATA / "demo.toml" if run.body == "demo" else folder / run.body / "case.toml"
    settings = {
        "mesh.edge_length_mm": run.edge_mm,
        "driver.modes": run.modes,
        "mechanics.law": f'"{run.law}"',
        "mechanics.element": f'"{run.element}"',
        "mechanics.solver": f'"{run.solver}"',
    }
    case = read_case(path, [f"{key}={value}" for key, value in settings.items()])
    states = read_states(case)
    predicted = expected_cost(case, states.before, states.after, n_pairs=1)
    began = time.perf_counter()
    result = estimate(case)
    return {
        **{key: getattr(run, key) for key in ("body", "edge_mm", "modes", "law", "element", "fitted")},
        "solver": predicted.solver,
        "processors": predicted.processors,
        "unknowns": 3 * len(result.space.points),
        "organs": len(states.before.tissues),
        "tets": [predicted.tets, len(result.space.mesh.tets)],
        "seconds": [round(predicted.seconds, 1), round(time.perf_counter() - began, 1)],
        "memory_gb": [round(predicted.memory_gb, 2), round(peak_mb() / 1024.0, 2)],
        "stages_s": dict(result.provenance.seconds),
        "status": result.estimation.status,
    }


WHAT = ("tetrahedra", "time, s", "memory, GB")
PAIRS = (f"{what}: {how}" for what in WHAT for how in ("predicted", "found"))
COLUMNS = ("case", "edge, mm", "modes", "solver", *PAIRS)
HEAD = (f"| {' | '.join(COLUMNS)} |", "|" + "---|" * len(COLUMNS))


def _line(row: dict[str, Any]) -> str:
    plain = {"linear": "", "neo-hookean": ", neo-Hookean"}[row["law"]] + (", P1" if row["element"] == "P1" else "")
    name = f"{row['body']}{plain}{'' if row['fitted'] else ', not fitted'}"
    cells = [name, f"{row['edge_mm']:g}", str(row["modes"]), row["solver"]]
    cells += [f"{value:g}" for key in ("tets", "seconds", "memory_gb") for value in np.asarray(row[key])]
    return f"| {' | '.join(cells)} |"


if __name__ == "__main__":
    raise SystemExit(main())
