"""What a cohort of small real estimates withstands, and how well workers share it.

    python benchmarks/cohort.py kills --rows 4 --runs 8    # resumed after kills, its numbers are the undisturbed ones
    python benchmarks/cohort.py bad --rows 16              # exactly the bad rows fail, each with its class
    python benchmarks/cohort.py speed --rows 40            # one worker and two; needs a quiet machine

kills: once in each run, at a random moment, the run or one of its processes is killed; the run is then resumed. bad:
rows with a wrong stage, a truncated image, an organ of a few voxels, noise that leaves nothing to estimate, or voxels
too fine for the memory limit; processes of others crash, are stopped, or are killed each time they start. Prints JSON;
the exit code is 1 where anything else comes out.
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
from contextlib import suppress
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np

from palpate.images import LabelImage, VoxelGrid, read_label_image, write_label_image
from palpate.phantoms import SpheresOptions, spheres

TEMPLATE = """
tissues = {core = {label = 1, role = "estimate"}, shell = {label = 2, role = "estimate"},
  frame = {label = 3, role = "driver"}, surroundings = {label = "remaining", role = "known", youngs_modulus_kpa = 10.0}}
mesh = {edge_length_mm = 11.0}
mechanics = {law = "linear", element = "P1"}
noise = {surface_sd_mm = 0.5}
driver = {modes = 8}
estimate = {start_ratios = [2.0]}
"""
BAD = ("usage", "input", "geometry", "solver", "resources", "crash", "timeout", "lost")
SIGNALS = {"crash": signal.SIGSEGV, "timeout": signal.SIGSTOP, "lost": signal.SIGKILL}
FINE = 14  # voxels along the edge of one: images that do not fit
NUMBERS = ("status", "estimates", "correlation", "fit", "starts", "counts", "mesh", "inputs")
BODIES = 3


def write_data(folder: Path, count: int) -> list[dict[str, str]]:
    """Write images and the template; gives so many rows of a table."""
    for body in range(BODIES):
        scene = spheres(SpheresOptions(seed=10 + body, spacing_mm=(2.5, 2.5, 2.5), truth_edge_mm=8.0))
        for name, image in (("before", scene.before), ("after", scene.after)):
            write_label_image(folder / f"{name}_{body}.nii.gz", image)
    (folder / "template.toml").write_text(TEMPLATE)
    rows = []
    for k in range(count):
        images = {name: f"{name}_{k % BODIES}.nii.gz" for name in ("before", "after")}
        rows.append({"id": f"r{k}", "patient": f"P{k // 2}", "stage": str(1 + k // 2 % 3), "case": ""} | images)
    return rows


def spoil(rows: list[dict[str, str]], folder: Path) -> None:
    """Make the first rows bad, one of each class."""
    for row, name in zip(rows, BAD, strict=False):
        row["id"] = f"bad-{name}"
    before = folder / "before_0.nii.gz"
    (folder / "cut.nii.gz").write_bytes(before.read_bytes()[:2000])
    whole = read_label_image(before)
    labels = np.where(whole.labels == 1, 2, whole.labels)
    labels[tuple(np.argwhere(whole.labels == 1)[:20].T)] = 1
    write_label_image(folder / "thin.nii.gz", LabelImage(labels, whole.grid))
    for name in ("before", "after"):
        coarse = read_label_image(folder / f"{name}_0.nii.gz")
        fine = coarse.labels.repeat(FINE, 0).repeat(FINE, 1).repeat(FINE, 2)
        grid = VoxelGrid(fine.shape, coarse.grid.affine @ np.diag([1.0 / FINE, 1.0 / FINE, 1.0 / FINE, 1.0]))
        write_label_image(folder / f"{name}_fine.nii.gz", LabelImage(fine, grid))
    noise = "surface_sd_mm = 100.0, correlation_length_mm = 100.0"
    images = 'images = {before = "before_0.nii.gz", after = ["after_0.nii.gz"]}\n'
    (folder / "noisy.toml").write_text(TEMPLATE.replace("surface_sd_mm = 0.5", noise) + images)
    changes: list[dict[str, str]] = [{"stage": "high"}, {"before": "cut.nii.gz"}, {"before": "thin.nii.gz"}]
    changes += [{"case": "noisy.toml", "before": "", "after": ""}]
    changes += [{"before": "before_fine.nii.gz", "after": "after_fine.nii.gz"}]
    for row, change in zip(rows, changes, strict=False):
        row.update(change)


def cohort(rows: list[dict[str, str]], folder: Path, name: str, *more: str) -> subprocess.Popen[bytes]:
    """Start the command, which writes into a folder of that name."""
    with (folder / "cohort.csv").open("w", newline="") as file:
        writer = csv.DictWriter(file, list(rows[0]))
        writer.writeheader()
        writer.writerows(rows)
    table = ["cohort", str(folder / "cohort.csv"), "--template", str(folder / "template.toml")]
    command = [sys.executable, "-m", "palpate", *table, "--output", str(folder / name), "--quiet", *more]
    return subprocess.Popen(command, stdout=subprocess.DEVNULL)


def numbers_of(folder: Path) -> dict[str, Any]:
    """What must be the same in two runs: every number of every result, nothing of time or place."""
    results = {path.parent.name: json.loads(path.read_text()) for path in folder.glob("cases/*/result.json")}
    return {name: {key: result[key] for key in NUMBERS} for name, result in results.items()}


def processes(run: subprocess.Popen[bytes], word: str = "") -> list[Any]:
    """A run's processes and itself, those with a word in their command."""
    psutil = import_module("psutil")
    with suppress(psutil.Error):
        root = psutil.Process(run.pid)
        return [each for each in (root, *root.children(recursive=True)) if word in " ".join(each.cmdline())]
    return []


def kills(rows: list[dict[str, str]], folder: Path, runs: int) -> dict[str, Any]:
    """Kill a process of each run and resume it."""
    began = time.monotonic()
    cohort(rows, folder, "undisturbed", "--workers", "2").wait()
    whole, wanted = time.monotonic() - began, numbers_of(folder / "undisturbed")
    equal, killed = [], 0
    for number in range(runs):
        run = cohort(rows, folder, f"run-{number}", "--workers", "2")
        time.sleep(random.uniform(0.2, 0.9) * whole)
        if found := processes(run):
            os.kill(random.choice(found).pid, signal.SIGKILL)
            killed += 1
        code = run.wait()
        if code != 0:
            code = cohort(rows, folder, f"run-{number}", "--workers", "2", "--resume").wait()
        equal.append(code == 0 and numbers_of(folder / f"run-{number}") == wanted)
    return {"runs": runs, "killed": killed, "equal": sum(equal), "as_it_should_be": all(equal)}


def bad(rows: list[dict[str, str]], folder: Path) -> dict[str, Any]:
    """Disturb the bad rows' processes."""
    spoil(rows, folder)
    run = cohort(rows, folder, "study", "--workers", "2", "--memory-limit", "1.5", "--time-limit", "300")
    sent = set[int]()
    while run.poll() is None:
        for name, number in SIGNALS.items():
            for process in processes(run, f"cases/bad-{name} "):
                if process.pid not in sent:
                    os.kill(process.pid, number)
                    sent.add(process.pid)
        time.sleep(0.1)
    table = list(csv.DictReader((folder / "study/cohort.csv").read_text().splitlines()))
    failed = {row["id"]: [row["failure_class"], row["message"]] for row in table if row["state"] != "done"}
    wanted = {f"bad-{name}": name for name in BAD[: len(rows)]}
    return {"failed": failed, "as_it_should_be": {name: found[0] for name, found in failed.items()} == wanted}


def speed(rows: list[dict[str, str]], folder: Path) -> dict[str, Any]:
    """Seconds of one worker and of two, and the share of them within the rows."""
    seconds, inside = list[float](), list[float]()
    for workers in (1, 2):
        began = time.monotonic()
        code = cohort(rows, folder, f"study-{workers}", "--workers", str(workers)).wait()
        seconds.append(time.monotonic() - began)
        marks = [json.loads(path.read_text()) for path in folder.glob(f"study-{workers}/cases/*/done.json")]
        inside.append(sum(mark["seconds"] for mark in marks))
    same = numbers_of(folder / "study-1") == numbers_of(folder / "study-2")
    told = {"seconds": [round(each, 1) for each in seconds], "efficiency": round(seconds[0] / (2.0 * seconds[1]), 2)}
    return told | {"seconds_in_rows": [round(each, 1) for each in inside], "as_it_should_be": same and code == 0}


def main() -> int:
    """Run what is asked for."""
    parser = argparse.ArgumentParser()
    parser.add_argument("part", choices=("kills", "bad", "speed"))
    parser.add_argument("--rows", type=int, default=8)
    parser.add_argument("--runs", type=int, default=8)
    asked = parser.parse_args()
    with tempfile.TemporaryDirectory() as place:
        folder = Path(place)
        rows = write_data(folder, asked.rows)
        parts = {"bad": bad, "speed": speed}
        found = kills(rows, folder, asked.runs) if asked.part == "kills" else parts[asked.part](rows, folder)
    print(json.dumps({"rows": asked.rows} | found, indent=1))
    return 0 if found["as_it_should_be"] else 1


if __name__ == "__main__":
    raise SystemExit(main())
