"""Work that computes nothing, to measure and test the scheduling of a cohort.

    python benchmarks/cohort_stub.py plan --rows 10000              # a plan of stub work: seconds and memory
    python benchmarks/cohort_stub.py run TABLE OUTPUT [--resume]    # what cohort_kills.py --stub starts

Each row sleeps for a moment and writes a result.json of the size of a real one, through the same staging, lock and
mark. It does not measure estimates.
"""

from __future__ import annotations

import argparse
import json
import resource
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from palpate.cohort.engines.dask import DaskEngine
from palpate.cohort.engines.local import LocalEngine
from palpate.cohort.engines.packing import Engine
from palpate.cohort.progress import status_of
from palpate.cohort.run import Options, run_cohort
from palpate.cohort.table import read_table
from palpate.cohort.task import Row
from palpate.study import OutputFolder

WORK = "cohort_stub_work:stub"


def run(table: Path, output: Path, *, engine: Engine, resume: bool) -> int:
    """The command with stub work."""
    rows = read_table(table, table.with_name("template.toml"))
    with OutputFolder(output).held():
        records = run_cohort(rows, output, engine, Options(resume=resume), progress=lambda _: None)
    return 0 if all(record.state == "done" for record in records) else 6


def plan(count: int, workers: int) -> dict[str, Any]:
    """So many rows of stub work: time a row, memory of this process, time of `status` and of a resume."""
    with tempfile.TemporaryDirectory() as place:
        output = Path(place)
        rows = [
            Row(f"r{number}", f"P{number // 3}", "1", 1 + number // 3 % 4, problem="stub") for number in range(count)
        ]
        began = time.monotonic()
        records = run_cohort(rows, output, LocalEngine(workers, work=WORK), Options(), progress=_every(count))
        took = time.monotonic() - began
        began = time.monotonic()
        status = status_of(output)
        told = time.monotonic() - began
        began = time.monotonic()
        run_cohort(rows, output, LocalEngine(workers, work=WORK), Options(resume=True), progress=lambda _: None)
        return {
            "rows": count,
            "workers": workers,
            "done": sum(record.state == "done" for record in records),
            "seconds": round(took, 1),
            "seconds_a_row": round(took / count, 4),
            "status": status.text(),
            "status_seconds": round(told, 2),
            "resume_seconds": round(time.monotonic() - began, 1),
            "peak_gb": round(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024 / 1e9, 3),
            "files_gb": round(sum(path.stat().st_size for path in output.rglob("*") if path.is_file()) / 1e9, 3),
        }


def _every(count: int) -> Any:
    """A listener that reports each tenth of the rows and the memory so far."""
    seen = [0]

    def listen(message: str) -> None:
        """Count."""
        seen[0] += 1
        if seen[0] % max(count // 10, 1) == 0:
            peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024 / 1e9
            print(f"{message} ({peak:.2f} GB)", file=sys.stderr, flush=True)

    return listen


def main(arguments: Sequence[str] | None = None) -> int:
    """Run what is asked for."""
    parser = argparse.ArgumentParser()
    commands = parser.add_subparsers(dest="command", required=True)
    planned = commands.add_parser("plan")
    planned.add_argument("--rows", type=int, default=10_000)
    planned.add_argument("--workers", type=int, default=2)
    started = commands.add_parser("run")
    started.add_argument("table", type=Path)
    started.add_argument("output", type=Path)
    started.add_argument("--scheduler")
    started.add_argument("--resume", action="store_true")
    options = parser.parse_args(arguments)
    if options.command == "plan":
        print(json.dumps(plan(options.rows, options.workers), indent=1))
        return 0
    engine = DaskEngine(options.scheduler, 2, WORK) if options.scheduler else LocalEngine(2, work=WORK)
    return run(options.table, options.output, engine=engine, resume=options.resume)


if __name__ == "__main__":
    raise SystemExit(main())
