"""What a cohort of small real estimates withstands, and how well workers share it; prints JSON.

    python benchmarks/cohort.py kills --rows 4 --runs 8    # resumed after kills, its numbers are the undisturbed ones
    python benchmarks/cohort.py bad --rows 16              # exactly the bad rows fail, each with its class
    python benchmarks/cohort.py speed --rows 40            # one worker and two; needs a quiet machine

kills: at a random moment of each run, the run or one of its processes is killed; the run is then resumed. bad: rows
with a wrong stage, a truncated image, an organ of a few voxels, or voxels too fine for the memory limit; processes of
others crash, are stopped, or are killed each time they start. The exit code is 1 where anything else comes out.
"""

from __future__ import annotations

import argparse
import csv
import json
import os
import random
import signal
import subprocess
import sys
import tempfile
import time
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np

from palpate.images import LabelImage, VoxelGrid, read_label_image, write_label_image
from palpate.phantoms import SpheresOptions, spheres

TEMPLATE = """
tissues.core = {label = 1, role = "estimate"}
tissues.shell = {label = 2, role = "estimate"}
tissues.frame = {label = 3, role = "driver"}
tissues.surroundings = {label = "remaining", role = "known", youngs_modulus_kpa = 10.0}
mesh.edge_length_mm = 11.0
mechanics = {law = "linear", element = "P1"}
noise.surface_sd_mm = 0.5
driver.modes = 8
"""
SIGNALS = {"crash": signal.SIGSEGV, "timeout": signal.SIGSTOP, "lost": signal.SIGKILL}
BAD = ("usage", "input", "geometry", "resources", *SIGNALS)
FINE = 14  # voxels along the edge of one: images that do not fit
NUMBERS = ("status", "estimates", "correlation", "fit", "starts", "counts", "mesh", "inputs")
Rows = list[dict[str, str]]


def write_data(folder: Path, count: int) -> Rows:
    """Write images of three bodies and the template; gives so many rows of a table."""
    for body in range(3):
        scene = spheres(SpheresOptions(seed=10 + body, spacing_mm=(2.5, 2.5, 2.5), truth_edge_mm=8.0))
        for name, image in (("before", scene.before), ("after", scene.after)):
            write_label_image(folder / f"{name}_{body}.nii.gz", image)
    (folder / "template.toml").write_text(TEMPLATE)
    who = [{"id": f"r{k}", "patient": f"P{k // 2}", "stage": str(1 + k // 2 % 3)} for k in range(count)]
    return [row | {name: f"{name}_{k % 3}.nii.gz" for name in ("before", "after")} for k, row in enumerate(who)]


def spoil(rows: Rows, folder: Path) -> None:
    """Make the first rows bad, one of each class."""
    (folder / "cut.nii.gz").write_bytes((folder / "before_0.nii.gz").read_bytes()[:400])
    whole = read_label_image(folder / "before_0.nii.gz")
    labels = np.where(whole.labels == 1, 2, whole.labels)
    labels[tuple(np.argwhere(whole.labels == 1)[:20].T)] = 1
    write_label_image(folder / "thin.nii.gz", LabelImage(labels, whole.grid))
    fine = whole.labels.repeat(FINE, 0).repeat(FINE, 1).repeat(FINE, 2)
    grid = VoxelGrid(fine.shape, whole.grid.affine @ np.diag([1.0 / FINE, 1.0 / FINE, 1.0 / FINE, 1.0]))
    write_label_image(folder / "fine.nii.gz", LabelImage(fine, grid))
    changes: Rows = [{"stage": "high"}, *({"before": f"{name}.nii.gz"} for name in ("cut", "thin", "fine")), {}, {}, {}]
    for row, name, change in zip(rows, BAD, changes, strict=False):
        row.update({"id": f"bad-{name}"} | change)


def start(rows: Rows, folder: Path, name: str, *more: str) -> subprocess.Popen[bytes]:
    """Start the command, which writes into a folder of that name."""
    with (folder / "cohort.csv").open("w", newline="") as file:
        writer = csv.DictWriter(file, list(rows[0]))
        writer.writeheader()
        writer.writerows(rows)
    table = [str(folder / "cohort.csv"), "--template", str(folder / "template.toml")]
    command = [sys.executable, "-m", "palpate", "cohort", *table, "--output", str(folder / name), "--quiet", *more]
    return subprocess.Popen(command, stdout=subprocess.DEVNULL)


def numbers_of(folder: Path) -> dict[str, Any]:
    """What must be the same in two runs: every number of every result, nothing of time or place."""
    results = {path.parent.name: json.loads(path.read_text()) for path in folder.glob("cases/*/result.json")}
    return {name: {key: result[key] for key in NUMBERS} for name, result in results.items()}


def kills(rows: Rows, folder: Path, runs: int) -> dict[str, Any]:
    """Kill a process of each run and resume it."""
    began = time.monotonic()
    start(rows, folder, "undisturbed", "--workers", "2").wait()
    seconds, wanted = time.monotonic() - began, numbers_of(folder / "undisturbed")
    equal = 0
    for number in range(runs):
        run = start(rows, folder, f"run-{number}", "--workers", "2")
        time.sleep(random.uniform(0.2, 0.9) * seconds)
        root = import_module("psutil").Process(run.pid)
        os.kill(random.choice([root, *root.children(recursive=True)]).pid, signal.SIGKILL)
        code = run.wait() and start(rows, folder, f"run-{number}", "--workers", "2", "--resume").wait()
        equal += code == 0 and numbers_of(folder / f"run-{number}") == wanted
    return {"runs": runs, "equal": equal, "as_it_should_be": equal == runs and len(wanted) == len(rows)}


def bad(rows: Rows, folder: Path) -> dict[str, Any]:
    """Disturb the bad rows' processes."""
    spoil(rows, folder)
    run = start(rows, folder, "study", "--workers", "2", "--memory-limit", "1.5", "--time-limit", "300")
    psutil, sent = import_module("psutil"), set[int]()
    while run.poll() is None:
        for process in psutil.process_iter(["cmdline"]):
            for name, number in SIGNALS.items():
                output = str(folder / f"study/cases/bad-{name}")
                if process.pid not in sent and output in (process.info["cmdline"] or ()):
                    os.kill(process.pid, number)
                    sent.add(process.pid)
        time.sleep(0.2)
    table = list(csv.DictReader((folder / "study/cohort.csv").read_text().splitlines()))
    failed = {row["id"]: [row["failure_class"], row["message"]] for row in table if row["state"] != "done"}
    wanted = {f"bad-{name}": name for name in BAD[: len(rows)]}
    return {"failed": failed, "as_it_should_be": {name: found[0] for name, found in failed.items()} == wanted}


def speed(rows: Rows, folder: Path) -> dict[str, Any]:
    """Seconds of one worker and of two."""
    seconds = []
    for workers in ("1", "2"):
        began = time.monotonic()
        start(rows, folder, f"study-{workers}", "--workers", workers).wait()
        seconds.append(round(time.monotonic() - began, 1))
    one, two = (numbers_of(folder / f"study-{workers}") for workers in ("1", "2"))
    told = {"seconds": seconds, "efficiency": round(seconds[0] / (2.0 * seconds[1]), 2)}
    return told | {"as_it_should_be": one == two and len(one) == len(rows)}


if __name__ == "__main__":
    parser = argparse.ArgumentParser()
    parser.add_argument("part", choices=("kills", "bad", "speed"))
    parser.add_argument("--rows", type=int, default=8)
    parser.add_argument("--runs", type=int, default=8)
    asked = parser.parse_args()
    with tempfile.TemporaryDirectory() as place:
        given = write_data(Path(place), asked.rows), Path(place)
        told = {"bad": bad, "speed": speed}[asked.part](*given) if asked.part != "kills" else kills(*given, asked.runs)
    print(json.dumps({"rows": asked.rows} | told, indent=1))
    raise SystemExit(0 if told["as_it_should_be"] else 1)
