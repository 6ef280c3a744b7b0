"""The cost of an estimate as `palpate check` predicts it, and the real cost: unknowns, seconds, memory.

    python benchmarks/cost.py [--cases N,N,...] [--mesh-only] [--json]

Each case runs in its own process, from label images on disk, so that its peak memory is measured alone. `check` meshes,
so its unknowns are those of the run. The guess before the mesh, by which `init` chooses an edge length, is printed,
too. The constants of `palpate.body.cost` are fitted to the demo; the other runs show how far they hold. The machine
must be otherwise idle.
`--mesh-only` only meshes, on any machine. The random pelves are always only meshed, because no mechanics moves them.
Simulated data.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Collection
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from memory import peak_mb
from random_pelves import random_pelvis, write_images

from palpate import check, init, make_mesh
from palpate.body import ExpectedCost, expected_cost, read_states
from palpate.case import Case, read_case
from palpate.demo import DATA
from palpate.images import Role, write_label_image
from palpate.phantoms import PelvisOptions, Scene, SpheresOptions, pelvis, spheres
from palpate.study import estimate


@dataclass(frozen=True)
class Run:
    """One case: the body, what it is computed with, and whether the constants were fitted to it."""

    body: str
    edge_mm: float
    modes: int = 90
    law: str = "linear"
    element: str = "auto"
    solver: str = "auto"
    fitted: bool = False


GB_A_MEBIBYTE = 1024**2 / 1e9  # the unit of `palpate.body.cost`
RUNS = (
    Run("spheres", 8.0, modes=30),
    Run("spheres", 6.0),
    Run("pelvis", 8.0),
    Run("pelvis", 8.0, element="P1"),
    Run("pelvis", 6.0),
    Run("demo", 10.0),
    Run("pelvis", 8.0, law="neo-hookean"),
    Run("pelvis", 5.5, law="neo-hookean"),
    Run("demo", 8.0),
    Run("pelvis", 6.5, law="neo-hookean"),
    Run("spheres", 5.0, law="neo-hookean"),
    Run("pelvis", 10.0, modes=30),
    Run("pelvis", 7.0, modes=150),
    Run("pelvis", 7.0),
    Run("pelvis", 7.0, solver="multigrid"),
    Run("bones", 8.0),
    Run("bones", 6.5, law="neo-hookean"),
    Run("thick", 8.0),
    Run("thick", 6.0, law="neo-hookean"),
    Run("demo", 12.0),
    Run("demo", 10.0, law="neo-hookean", fitted=True),
    *(Run(f"random {seed}", edge) for seed, edge in ((0, 6.0), (5, 8.0), (9, 7.0), (12, 6.5), (17, 8.0))),
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
    parser.add_argument("--mesh-only", action="store_true", help="no estimate: unknowns alone")
    parser.add_argument("--one", nargs=2, help=argparse.SUPPRESS)
    parser.add_argument("--images", help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.images:
        _write_images(Path(arguments.images), {RUNS[int(number)].body for number in arguments.cases.split(",")})
        return 0
    if arguments.one:
        print(json.dumps(_one(RUNS[int(arguments.one[0])], Path(arguments.one[1]), solve=not arguments.mesh_only)))
        return 0
    rows = []
    with tempfile.TemporaryDirectory() as folder:
        _child("--images", folder, "--cases", arguments.cases)
        only = ["--mesh-only"] * arguments.mesh_only
        for number in arguments.cases.split(","):
            rows.append(json.loads(_child("--one", number, folder, *only)))
            print(_line(rows[-1]), file=sys.stderr, flush=True)
    print(json.dumps({"runs": rows}, indent=1) if arguments.json else "\n".join([*HEAD, *(_line(row) for row in rows)]))
    return 0


def _child(*arguments: str) -> str:
    command = [sys.executable, str(Path(__file__)), *arguments]
    return subprocess.run(command, check=True, stdout=subprocess.PIPE, text=True).stdout


SCENES: dict[str, Callable[[], Scene]] = {
    "spheres": lambda: spheres(SpheresOptions(seed=2, truth_edge_mm=5.0)),
    "pelvis": lambda: pelvis(PelvisOptions(seed=1, truth_edge_mm=4.0)),
    "bones": lambda: pelvis(PelvisOptions(seed=3, truth_edge_mm=4.0, bones=True, tumour=True)),
    "thick": lambda: pelvis(PelvisOptions(seed=4, truth_edge_mm=4.0, spacing_mm=(1.0, 1.0, 4.0))),
}


def _write_images(folder: Path, bodies: Collection[str]) -> None:
    """The label images of the phantoms, whose truths need more memory than their estimates."""
    for name in bodies:
        if name == "demo":
            continue
        (folder / name).mkdir()
        if name in SCENES:
            write_case(folder / name, SCENES[name]())
            continue
        before, after, table = write_images(folder / name, random_pelvis(int(name.split()[1])))
        init(before, after, labels=table, output=folder / name)


def write_case(folder: Path, scene: Scene, *, unnamed: Collection[str] = ()) -> None:
    """A scene's images and a case of them, as a user has them; `unnamed` tissues are part of the surroundings."""
    write_label_image(folder / "before.nii.gz", scene.before)
    write_label_image(folder / "after.nii.gz", scene.after)
    roles = (Role.ESTIMATE, Role.DRIVER, Role.RIGID)
    seen = [t for t in scene.tissues if t.role in roles and t.name not in unnamed]
    lines = [f'"{t.name}" = {{label = {t.labels[0]}, role = "{t.role.value}"}}' for t in seen]
    (folder / "case.toml").write_text(CASE + "\n".join(lines))


def _one(run: Run, folder: Path, *, solve: bool) -> dict[str, object]:
    path = DATA / "demo.toml" if run.body == "demo" else folder / run.body / "case.toml"
    settings = {
        "mesh.edge_length_mm": run.edge_mm,
        "driver.modes": run.modes,
        "mechanics.law": f'"{run.law}"',
        "mechanics.element": f'"{run.element}"',
        "mechanics.solver": f'"{run.solver}"',
    }
    overrides = [f"{key}={value}" for key, value in settings.items()]
    case = read_case(path, overrides)
    states = read_states(case)
    guessed = expected_cost(case, states.before, states.after, n_pairs=1)
    predicted = check(path, overrides).cost or guessed
    row = {
        **{key: getattr(run, key) for key in ("body", "edge_mm", "modes", "law", "element", "fitted")},
        "solver": predicted.solver,
        "processors": predicted.processors,
        "organs": len(states.before.tissues),
    }
    if not solve or run.body.startswith("random"):
        found = make_mesh(case).mesh_summary.dofs
        return row | {"unknowns": [guessed.unknowns, predicted.unknowns, found], "seconds": [], "memory_gb": []}
    return row | _estimated(case, guessed, predicted)


def _estimated(case: Case, guessed: ExpectedCost, predicted: ExpectedCost) -> dict[str, object]:
    """What the estimate of a case took, after what was predicted."""
    began, earlier = time.perf_counter(), peak_mb()
    result = estimate(case)
    return {
        "unknowns": [guessed.unknowns, predicted.unknowns, result.mesh_summary.dofs],
        "tets": len(result.space.mesh.tets),
        "seconds": [round(predicted.seconds, 1), round(time.perf_counter() - began, 1)],
        "memory_gb": [round(predicted.memory_gb, 2), round(peak_mb() * GB_A_MEBIBYTE, 2)],
        "memory_of_check_gb": round(earlier * GB_A_MEBIBYTE, 2),
        "stages_s": dict(result.provenance.seconds),
        "status": result.estimation.status,
    }


COLUMNS = (
    *("case", "edge, mm", "modes", "solver", "unknowns: guessed", "`check`", "found"),
    *("time, s: `check`", "found", "memory, GB: `check`", "found"),
)
HEAD = (f"| {' | '.join(COLUMNS)} |", "|" + "---|" * len(COLUMNS))


def _line(row: dict[str, Any]) -> str:
    plain = {"linear": "", "neo-hookean": ", neo-Hookean"}[row["law"]] + (", P1" if row["element"] == "P1" else "")
    name = f"{row['body']}{plain}{', fitted' if row['fitted'] else ''}"
    cells = [name, f"{row['edge_mm']:g}", str(row["modes"]), row["solver"], *map(str, row["unknowns"])]
    cells += [f"{value:g}" for key in ("seconds", "memory_gb") for value in row[key]] or ["-"] * 4
    return f"| {' | '.join(cells)} |"


if __name__ == "__main__":
    raise SystemExit(main())
