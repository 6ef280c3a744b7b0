"""How well two workers share a cohort of small real cases, and each case's overhead; needs an otherwise idle machine.

    python benchmarks/cohort_speed.py --rows 40

Both runs give each worker one thread. Efficiency is the time of one worker over twice that of two. Overhead is the time
of the run with one worker, from its first to its last row, less the time within the cases (`seconds` of their marks),
for each row. The times to start the program and to write the tables are printed separately. Prints JSON.
"""

from __future__ import annotations

import argparse
import json
import os
import re
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

from cohort_case import make_table

from palpate.study import read_json

LINE = re.compile(r"^\[ *([0-9.]+) s\] (.*)$")


def timed(table: Path, output: Path, workers: int) -> dict[str, Any]:
    """A run with so many workers of one thread each: when its rows ended, and how long they say they took."""
    command = [
        sys.executable,
        "-m",
        "palpate",
        "cohort",
        str(table),
        "--output",
        str(output),
        "--workers",
        str(workers),
    ]
    environment = {**os.environ, "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
    began = time.monotonic()
    done = subprocess.run(
        [*command, "--template", str(table.with_name("template.toml"))],
        env=environment,
        check=True,
        capture_output=True,
        text=True,
    )
    whole = time.monotonic() - began
    told = [match for line in done.stderr.splitlines() if (match := LINE.match(line))]
    read = next(float(match[1]) for match in told if "reading what each depends on" in match[2])
    ended = [float(match[1]) for match in told if " to go of " in match[2]]
    marks = [read_json(path) for path in output.glob("cases/*/done.json")]
    inside = [float(mark["seconds"]) for mark in marks]
    peaks = [float(mark["peak_gb"]) for mark in marks]
    return {
        "workers": workers,
        "seconds": round(whole, 1),
        "rows_began_s": read,
        "rows_ended_s": ended[-1],
        "inside_cases_s": round(sum(inside), 1),
        "first_row_s": ended[0],
        "first_case_s": round(max(inside), 2),
        "peak_gb": max(peaks),
    }


def main() -> int:
    """Run it."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--rows", type=int, default=40)
    rows = parser.parse_args().rows
    with tempfile.TemporaryDirectory() as place:
        table = make_table(Path(place) / "data", rows)
        one, two = (timed(table, Path(place) / f"study-{workers}", workers) for workers in (1, 2))
    between = (one["rows_ended_s"] - one["rows_began_s"] - one["inside_cases_s"]) / rows
    summary = {
        "rows": rows,
        "efficiency": round(one["seconds"] / (2.0 * two["seconds"]), 3),
        "efficiency_of_the_rows": round(
            (one["rows_ended_s"] - one["rows_began_s"]) / (2.0 * (two["rows_ended_s"] - two["rows_began_s"])), 3
        ),
        "overhead_a_row_s": round(between, 3),
    }
    print(json.dumps(summary | {"runs": [one, two]}, indent=1))
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
