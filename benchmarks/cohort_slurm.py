"""A cohort of small real cases on SLURM's job array and on dask-jobqueue, compared with the same on this machine.

    eval "$(benchmarks/cohort_slurm_setup.sh start FOLDER)"    # a SLURM of this machine, where there is none
    python benchmarks/cohort_slurm.py --folder FOLDER_THAT_THE_NODES_SEE

Prints JSON: whether the numbers are the same, and the queue's messages. The exit code is 1 where they differ.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from cohort_case import make_table, numbers_of

from palpate.study import read_json


def cohort(table: Path, output: Path, *more: str) -> dict[str, Any]:
    """Run the command; its time and exit code."""
    began = time.monotonic()
    command = [sys.executable, "-m", "palpate", "cohort", str(table), "--output", str(output), "--quiet", *more]
    done = subprocess.run(
        [*command, "--template", str(table.with_name("template.toml"))], check=False, capture_output=True, text=True
    )
    return {"exit_code": done.returncode, "seconds": round(time.monotonic() - began, 1), "said": done.stderr[-500:]}


def on_jobqueue(table: Path, output: Path, jobs: int) -> dict[str, Any]:
    """The same on Dask workers that dask-jobqueue has asked SLURM for."""
    from dask_jobqueue import SLURMCluster  # noqa: PLC0415 - an extra

    places: dict[str, Any] = {"log_directory": str(output.parent / "jobqueue"), "local_directory": str(output.parent)}
    with SLURMCluster(
        cores=1, processes=1, memory="4GB", interface=None, scheduler_options={"dashboard_address": None}, **places
    ) as cluster:
        cluster.scale(jobs=jobs)
        return cohort(table, output, "--engine", "dask", "--scheduler", cluster.scheduler_address)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run all three, and compare."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--folder", type=Path, required=True)
    parser.add_argument("--rows", type=int, default=4)
    parser.add_argument("--jobs", type=int, default=2)
    options = parser.parse_args(arguments)
    folder = options.folder.absolute()
    table = make_table(folder / "data", options.rows)
    told = {"local": cohort(table, folder / "local", "--workers", "2")}
    told["slurm"] = cohort(table, folder / "slurm", "--engine", "slurm", "--workers", str(options.jobs))
    told["slurm"]["job"] = read_json(folder / "slurm/slurm/job.json")["job"]
    told["jobqueue"] = on_jobqueue(table, folder / "jobqueue", options.jobs)
    reference = numbers_of(folder / "local")
    for name in ("slurm", "jobqueue"):
        told[name]["same_numbers"] = numbers_of(folder / name) == reference
    print(json.dumps({"rows": options.rows} | told, indent=1))
    return 0 if all(told[name]["same_numbers"] for name in ("slurm", "jobqueue")) else 1


if __name__ == "__main__":
    raise SystemExit(main())
