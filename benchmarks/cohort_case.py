"""Small cohorts of real estimates, for the benchmarks of cohorts: balls in balls, coarse, under the linear law."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from palpate.images import write_label_image
from palpate.phantoms import SpheresOptions, spheres
from palpate.study import read_json

TEMPLATE = """\
[tissues.core]
label = 1
role = "estimate"

[tissues.shell]
label = 2
role = "estimate"

[tissues.frame]
label = 3
role = "driver"

[tissues.surroundings]
label = "remaining"
role = "known"
youngs_modulus_kpa = 10.0

[mesh]
edge_length_mm = 11.0

[mechanics]
law = "linear"
element = "P1"

[noise]
surface_sd_mm = 0.5

[driver]
modes = 8

[estimate]
start_ratios = [2.0]
"""


def make_table(folder: Path, rows: int, *, bodies: int = 3) -> Path:
    """Write images of so many bodies, a template and a table of so many rows; gives the table's path."""
    folder.mkdir(parents=True, exist_ok=True)
    for number in range(bodies):
        scene = spheres(SpheresOptions(seed=10 + number, spacing_mm=(2.5, 2.5, 2.5), truth_edge_mm=8.0))
        for name, image in (("before", scene.before), ("after", scene.after)):
            write_label_image(folder / f"{name}_{number}.nii.gz", image)
    (folder / "template.toml").write_text(TEMPLATE)
    lines = ["id,patient,session,stage,before,after"]
    for row in range(rows):
        body, patient = row % bodies, row // 2
        lines.append(f"r{row},P{patient},{row % 2},{1 + patient % 3},before_{body}.nii.gz,after_{body}.nii.gz")
    table = folder / "cohort.csv"
    table.write_text("\n".join(lines) + "\n")
    return table


def make_stub_table(folder: Path, rows: int) -> Path:
    """A table of rows that only write files, for a third of a second each; gives its path."""
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "template.toml").write_text(TEMPLATE)
    lines = [f"r{row},P{row // 2},{row % 2},{1 + row // 2 % 3},b{row}.nii.gz,a.nii.gz,0.3" for row in range(rows)]
    table = folder / "cohort.csv"
    table.write_text("\n".join(["id,patient,session,stage,before,after,seconds", *lines]) + "\n")
    return table


def numbers_of(folder: Path) -> dict[str, Any]:
    """What must be the same in two runs of a cohort: every number of every result, nothing of time or place."""
    found: dict[str, Any] = {}
    for path in sorted((folder / "cases").iterdir()):
        mark = read_json(path / "done.json")
        document = read_json(path / "result.json")
        kept = ("status", "estimates", "correlation", "fit", "starts", "counts", "mesh", "inputs", "case")
        found[path.name] = {"state": mark["state"], "key": mark["key"]} | {key: document[key] for key in kept}
    return found
