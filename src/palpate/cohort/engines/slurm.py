"""The engine on SLURM: one job array, each part of which runs `palpate cohort --task N`; files tell how it goes."""

from __future__ import annotations

import json
import math
import re
import shlex
import shutil
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass
from pathlib import Path

from palpate.cohort.engines.local import LocalEngine
from palpate.cohort.engines.packing import again, marked
from palpate.cohort.plan import read_mark
from palpate.cohort.resolve import case_of
from palpate.cohort.task import LEAST_MEMORY_GB, Outcome, Task
from palpate.errors import InputDataError, PalpateError, ResourceError
from palpate.parallel import mapped
from palpate.progress import Line, Progress
from palpate.study.cost import expected_cost
from palpate.study.outputs import OutputFolder, read_json, write_json, write_text
from palpate.study.read import read_states

FOLDER, PARTS, SCRIPT, JOB = "slurm", "parts.json", "array.sh", "job.json"
MOST_PARTS = 1000  # SLURM's own default allows 1001
POLL_S = 5.0
PATIENCE = 3  # how often in a row SLURM may not know the job before it counts as gone
JOB_NUMBER = re.compile(r"[0-9]{1,12}")
HOLD_GB = 0.5  # of the process that watches a case


@dataclass(frozen=True, slots=True)
class SlurmEngine:
    """A job array in SLURM, of which so many parts run at a time (None: as SLURM likes).

    folder: the cohort's, which the nodes see under the same path; command: what a part runs before its own arguments;
    poll_seconds: how often files and SLURM's queue are looked at. Partition, account, time ... are taken by sbatch from
    its own environment variables (SBATCH_PARTITION ...).
    """

    folder: Path
    workers: int | None = None
    command: tuple[str, ...] = (sys.executable, "-m", "palpate")
    poll_seconds: float = POLL_S

    @property
    def name(self) -> str:
        """As `--engine` calls it."""
        return "slurm"

    def outcomes(self, tasks: Sequence[Task]) -> Iterator[Outcome]:
        """The outcome of each task, as its mark appears; what SLURM loses is submitted again. `ResourceError`."""
        for program in ("sbatch", "squeue", "scancel"):
            if shutil.which(program) is None:
                raise ResourceError(f"--engine slurm needs SLURM's {program}, which is not installed on this machine")
        with suppress(
            InputDataError, ResourceError
        ):  # an array of an earlier run is ended: its rows are in the new one
            job = str(read_json(self.folder / FOLDER / JOB).get("job"))
            if JOB_NUMBER.fullmatch(job):
                _run("scancel", job)
        left = {task.row.id: task for task in tasks}
        while left:
            job = self._submit(list(left.values()))
            try:
                yield from self._watched(job, left)
            finally:
                _run("scancel", job)
            lost = [Outcome.failed(task, "lost", "its SLURM job is gone", cause="lost") for task in left.values()]
            for outcome in lost:
                task = left.pop(outcome.id)
                if (next_one := again(task, outcome)) is not None:
                    left[outcome.id] = next_one
                else:
                    yield marked(task, outcome)

    def _watched(self, job: str, left: dict[str, Task]) -> Iterator[Outcome]:
        """Outcomes as they appear, taken out of `left`, until all are there or the job is gone."""
        absent = 0
        while left and absent < PATIENCE:
            absent = 0 if _run("squeue", "--noheader", "--jobs", job).strip() else absent + 1
            for task in list(left.values()):
                mark = read_mark(Path(task.folder), checked=False)
                if mark is not None:
                    del left[task.row.id]
                    yield mark
            if left:
                time.sleep(self.poll_seconds)

    def _submit(self, tasks: Sequence[Task]) -> str:
        count = min(len(tasks), MOST_PARTS)
        parts = [[asdict(task) for task in tasks[number::count]] for number in range(count)]
        memory_mb = math.ceil(1000.0 * (max(mapped(_memory_gb, tasks)) + HOLD_GB))
        place = (self.folder / FOLDER).absolute()
        command = shlex.join([*self.command, "cohort", "--quiet", "--output", str(self.folder.absolute())])
        script = [
            "#!/bin/sh",
            "#SBATCH --job-name=palpate",
            f"#SBATCH --array=0-{count - 1}{f'%{self.workers}' if self.workers else ''}",
            "#SBATCH --ntasks=1 --cpus-per-task=1",
            f"#SBATCH --mem={memory_mb}M",
            f"#SBATCH --output={place}/%A_%a.log",
            "#SBATCH --requeue",
            f'exec {command} --task "$SLURM_ARRAY_TASK_ID"',
        ]
        with OutputFolder(place).new_files() as area:
            write_json(area / PARTS, {"schema": "palpate.parts/1", "parts": parts})
            write_text(area / SCRIPT, "\n".join(script) + "\n")
        job = _run("sbatch", "--parsable", str(place / SCRIPT)).split(";")[0].strip()
        if not JOB_NUMBER.fullmatch(job):
            raise ResourceError(f"sbatch did not take the job array {place / SCRIPT}: {job[:200]}")
        with OutputFolder(place).new_files() as area:
            write_json(area / JOB, {"schema": "palpate.job/1", "job": job})
        return job


def run_part(folder: Path, number: int, progress: Progress) -> list[Outcome]:
    """Compute part `number` of the job array in a cohort's folder, as one of its jobs; rows that are done are left.

    Raises `InputDataError` when there is no such part.
    """
    parts = read_json(folder / FOLDER / PARTS).get("parts")
    if not isinstance(parts, list) or not 0 <= number < len(parts):
        raise InputDataError(f"{folder / FOLDER / PARTS} has no part {number}; --task is for SLURM's job array alone")
    tasks = [Task.from_json(json.dumps(content)) for content in parts[number]]
    marks = [read_mark(Path(task.folder)) for task in tasks]
    left = [task for task, mark in zip(tasks, marks, strict=True) if mark is None or mark.key != task.key]
    outcomes = []
    for outcome in LocalEngine(1).outcomes(left):
        progress(Line(f"{outcome.id}: {outcome.state} {outcome.message}"))
        outcomes.append(outcome)
    return outcomes


def _memory_gb(task: Task) -> float:
    """Memory (GB) that a case is allowed, by its prediction; little for one that cannot be read, which fails early."""
    if task.limits.memory_gb is not None:
        return task.limits.memory_gb
    try:
        case = case_of(task.row, task.overrides)
        states = read_states(case)
        cost = expected_cost(case, states.before, states.after, n_pairs=1 + len(case.pairs), mesh=states.mesh)
    except PalpateError:
        return LEAST_MEMORY_GB
    return task.limits.memory_for(cost.memory_gb)


def _run(program: str, *arguments: str) -> str:
    """What a program of SLURM's says; empty when it fails."""
    path = shutil.which(program)
    if path is None:
        return ""
    done = subprocess.run([path, *arguments], capture_output=True, text=True, check=False, timeout=120)  # noqa: S603
    return done.stdout if done.returncode == 0 else (done.stderr if program == "sbatch" else "")
