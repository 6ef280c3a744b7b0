"""A cohort in which a tenth of the rows are bad, of every class: exactly those must fail, each with its class.

    python benchmarks/cohort_bad.py              # 80 rows, 8 of them bad
    python benchmarks/cohort_bad.py --rows 16

The bad rows have a wrong stage, a truncated image, an organ of a few voxels, noise that leaves nothing to estimate, or
voxels too fine for the memory limit. Other rows' processes crash (SIGSEGV), are stopped until their time is over, or
are killed each time they start. Prints JSON; the exit code is 1 where a row ends differently.
"""

from __future__ import annotations

import argparse
import csv
import json
import os
import signal
import subprocess
import sys
import tempfile
import time
from contextlib import suppress
from pathlib import Path

import numpy as np
from cohort_case import TEMPLATE, make_table

from palpate.images import LabelImage, VoxelGrid, read_label_image, write_label_image

BAD = ("usage", "input", "geometry", "solver", "resources", "crash", "timeout", "lost")
SIGNALS = {"crash": signal.SIGSEGV, "timeout": signal.SIGSTOP, "lost": signal.SIGKILL}
MEMORY_GB, SECONDS = 1.5, 300.0
FINE = 14  # voxels along the edge of one: images that do not fit


def spoil(table: Path) -> None:
    """Make the first rows of a table bad, one of each class."""
    folder = table.parent
    image = (folder / "before_0.nii.gz").read_bytes()
    (folder / "cut.nii.gz").write_bytes(image[: len(image) // 2])
    whole = read_label_image(folder / "before_0.nii.gz")
    labels = whole.labels.copy()
    inside = np.argwhere(labels == 1)
    labels[labels == 1] = 2
    labels[tuple(inside[:20].T)] = 1
    write_label_image(folder / "thin.nii.gz", LabelImage(labels, whole.grid))
    images = '[images]\nbefore = "before_0.nii.gz"\nafter = ["after_0.nii.gz"]\n'
    noisy = TEMPLATE.replace("surface_sd_mm = 0.5", "surface_sd_mm = 100.0\ncorrelation_length_mm = 100.0")
    (folder / "noisy.toml").write_text(noisy + images)
    for name in ("before_0", "after_0"):
        coarse = read_label_image(folder / f"{name}.nii.gz")
        fine = coarse.labels.repeat(FINE, 0).repeat(FINE, 1).repeat(FINE, 2)
        affine = coarse.grid.affine @ np.diag([1.0 / FINE, 1.0 / FINE, 1.0 / FINE, 1.0])
        write_label_image(folder / f"fine_{name}.nii.gz", LabelImage(fine, VoxelGrid(fine.shape, affine)))
    (folder / "fine.toml").write_text(
        TEMPLATE + images.replace("before_0", "fine_before_0").replace("after_0", "fine_after_0")
    )
    rows = list(csv.DictReader(table.read_text().splitlines()))
    changes = {
        "usage": {"stage": "high"},
        "input": {"before": "cut.nii.gz"},
        "geometry": {"before": "thin.nii.gz"},
        "solver": {"case": "noisy.toml", "before": "", "after": ""},
        "resources": {"case": "fine.toml", "before": "", "after": ""},
    }
    for row, name in zip(rows, BAD, strict=False):
        row.update({"id": f"bad-{name}"} | changes.get(name, {}))
    with table.open("w", newline="") as file:
        writer = csv.DictWriter(file, [*rows[0], *(["case"] if "case" not in rows[0] else [])], restval="")
        writer.writeheader()
        writer.writerows(rows)


def disturb(output: Path, done: set[int]) -> None:
    """Send each child of a row that is to be disturbed its signal, once."""
    for name, number in SIGNALS.items():
        with suppress(OSError, ValueError):
            pid = int((output / f"cases/bad-{name}/.palpate.lock").read_text())
            if pid not in done:
                os.kill(pid, number)
                done.add(pid)


def main() -> int:
    """Run it."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--rows", type=int, default=80)
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as place:
        table = make_table(Path(place) / "data", arguments.rows)
        spoil(table)
        output = Path(place) / "study"
        command = [sys.executable, "-m", "palpate", "cohort", str(table), "--output", str(output), "--workers", "2"]
        command += ["--template", str(table.with_name("template.toml")), "--quiet"]
        command += ["--memory-limit", str(MEMORY_GB), "--time-limit", str(SECONDS)]
        began = time.monotonic()
        run = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        sent = {run.pid}  # it holds a row's folder itself, for a moment, to write a failure's mark
        while run.poll() is None:
            disturb(output, sent)
            time.sleep(0.02)
        rows = list(csv.DictReader((output / "cohort.csv").read_text().splitlines()))
        found = {row["id"]: row["failure_class"] for row in rows if row["state"] != "done"}
        wanted = {f"bad-{name}": name for name in BAD[: arguments.rows]}
        print(
            json.dumps(
                {
                    "rows": len(rows),
                    "exit_code": run.returncode,
                    "seconds": round(time.monotonic() - began, 1),
                    "failed": {
                        row["id"]: [row["failure_class"], row["message"]] for row in rows if row["state"] != "done"
                    },
                    "exactly_the_bad_ones": found == wanted,
                },
                indent=1,
            )
        )
        return 0 if found == wanted and run.returncode == 0 else 1


if __name__ == "__main__":
    raise SystemExit(main())
