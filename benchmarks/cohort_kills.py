"""Cohorts that are killed at random moments and resumed, compared with an undisturbed one.

    python benchmarks/cohort_kills.py --engine local --runs 100    # hours: each run computes small real cases
    python benchmarks/cohort_kills.py --engine dask --runs 100
    python benchmarks/cohort_kills.py --engine local --runs 100 --stub    # minutes: rows that only write files

Once in each run, at a random moment, a process is killed: the run itself, the child that computes, or (dask) the
scheduler or a worker. The run is then resumed until it ends by itself. Its results must equal those of the undisturbed
run to the last digit, with one mark for each row and no hidden file left. Prints JSON; the exit code is 1 where a run
differs.
"""

from __future__ import annotations

import argparse
import json
import os
import random
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from multiprocessing import get_context
from pathlib import Path
from typing import Any

from cohort_case import make_stub_table, make_table, numbers_of

from cohort_stub import WORK, run
from palpate.cohort.engines.dask import DaskEngine
from palpate.cohort.engines.local import LocalEngine
from palpate.cohort.engines.packing import Engine
from palpate.errors import PalpateError

PALPATE = [sys.executable, "-m", "palpate"]
MOST_RESUMES = 6
TARGETS = {"local": ("run", "child"), "dask": ("run", "scheduler", "dask worker", "child")}
QUIET = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
NOTHING = "nothing"
CHILD = "palpate.cohort.child"


class Cluster:
    """A Dask scheduler and two workers as processes of their own, started again when they are gone."""

    def __init__(self, port: int) -> None:
        self.address = f"tcp://127.0.0.1:{port}"
        self._port = port
        self._processes: dict[str, subprocess.Popen[bytes]] = {}

    def start(self) -> None:
        """Whatever is gone, again."""
        scheduler = ["scheduler", "--host", "127.0.0.1", "--port", str(self._port), "--no-dashboard"]
        worker = ["worker", self.address, "--nthreads", "1", "--memory-limit", "4GB", "--no-dashboard", "--no-nanny"]
        if not self._runs("scheduler"):
            self.stop()
            self._processes["scheduler"] = self._popen(scheduler)
            time.sleep(4.0)
        for name in ("worker-1", "worker-2"):
            if not self._runs(name):
                self._processes[name] = self._popen([*worker, "--name", f"{name}-{time.time()}"])

    def stop(self) -> None:
        """End all of them."""
        for process in self._processes.values():
            process.kill()
            process.wait()
        self._processes.clear()

    def pids(self, what: str) -> list[int]:
        """Of the scheduler, or of the workers."""
        return [process.pid for name, process in self._processes.items() if name.startswith(what) and self._runs(name)]

    def _runs(self, name: str) -> bool:
        return name in self._processes and self._processes[name].poll() is None

    @staticmethod
    def _popen(arguments: list[str]) -> subprocess.Popen[bytes]:
        command = [sys.executable, "-m", "distributed.cli.dask_" + arguments[0], *arguments[1:]]
        places = [str(Path(__file__).parent), *filter(None, [os.environ.get("PYTHONPATH")])]
        environment = {**os.environ, "PYTHONPATH": os.pathsep.join(places)}
        return subprocess.Popen(command, env=environment, **QUIET)  # type: ignore[call-overload,no-any-return]


def children(pid: int) -> list[int]:
    """Processes that a process has started."""
    with suppress(OSError):
        return [
            int(word)
            for task in Path(f"/proc/{pid}/task").iterdir()
            for word in (task / "children").read_text().split()
        ]
    return []


def command_of(pid: int) -> str:
    """Its command line; empty when it is gone."""
    with suppress(OSError):
        return Path(f"/proc/{pid}/cmdline").read_bytes().replace(b"\0", b" ").decode(errors="replace")
    return ""


def computing(roots: list[int]) -> list[int]:
    """The processes of these that work on a row."""
    found = [child for root in roots for child in children(root)]
    return [pid for pid in found if CHILD in command_of(pid)]


def victim(target: str, run: int, cluster: Cluster | None) -> int | None:
    """A process to kill; None where none of that kind runs at the moment."""
    roots = [run] if cluster is None else cluster.pids("worker")
    choices = {
        "run": [run],
        "scheduler": [] if cluster is None else cluster.pids("scheduler"),
        "dask worker": roots,
        "child": computing(roots),
    }[target]
    return random.choice(choices) if choices else None


class Forked:
    """A run of stub work in a child of this process, which has imported everything; what is needed of a `Popen`."""

    def __init__(self, table: Path, output: Path, scheduler: str | None, resume: bool) -> None:
        engine = DaskEngine(scheduler, 2, WORK) if scheduler else LocalEngine(2, work=WORK)
        options = {"engine": engine, "resume": resume}
        self._process = get_context("fork").Process(target=_stub_run, args=(table, output), kwargs=options)
        self._process.start()
        self.pid = int(self._process.pid or 0)

    def poll(self) -> int | None:
        """Exit code; None while it runs."""
        return self._process.exitcode

    def wait(self) -> int:
        """Exit code, when it has ended."""
        self._process.join()
        return int(self._process.exitcode or 0)


def _stub_run(table: Path, output: Path, *, engine: Engine, resume: bool) -> None:
    os.setpgid(0, 0)
    try:
        raise SystemExit(run(table, output, engine=engine, resume=resume))
    except PalpateError:
        raise SystemExit(6) from None


def cohort(table: Path, output: Path, cluster: Cluster | None, *more: str) -> Forked | subprocess.Popen[bytes]:
    """Start the command, or the same with rows that only write files."""
    if "stub" in table.parent.name:
        return Forked(table, output, None if cluster is None else cluster.address, "--resume" in more)
    engine = ["--workers", "2"] if cluster is None else ["--engine", "dask", "--scheduler", cluster.address]
    command = [*PALPATE, "cohort", str(table), "--template", str(table.with_name("template.toml"))]
    return subprocess.Popen([*command, "--output", str(output), *engine, "--quiet", *more], **QUIET)  # type: ignore[call-overload,no-any-return]


def disturbed(table: Path, output: Path, cluster: Cluster | None, target: str, after: float) -> dict[str, Any]:
    """One run that is killed at a moment, and resumed until it ends by itself."""
    shutil.rmtree(output, ignore_errors=True)
    started = cohort(table, output, cluster)
    time.sleep(after)
    pid = None
    while started.poll() is None and (pid := victim(target, started.pid, cluster)) is None:
        time.sleep(0.01)  # it has not begun, or is between two rows
    if pid is not None:
        with suppress(ProcessLookupError):
            os.kill(pid, signal.SIGKILL)
    codes = [started.wait()]
    while codes[-1] != 0 and len(codes) <= MOST_RESUMES:
        if cluster is not None:
            cluster.start()
        codes.append(cohort(table, output, cluster, "--resume").wait())
    if cluster is not None:
        cluster.start()
    return {"target": target if pid is not None else NOTHING, "after_s": round(after, 2), "exit_codes": codes}


def fault(output: Path, reference: dict[str, Any]) -> str:
    """How a resumed run differs from the undisturbed one; empty where it does not."""
    try:
        found = numbers_of(output)
    except PalpateError as error:
        return str(error)
    if found != reference:
        return f"other numbers: {sorted(name for name in reference if found.get(name) != reference[name])}"
    if len((output / "cohort.csv").read_text().splitlines()) != len(reference) + 1:
        return "cohort.csv has another number of rows"
    hidden = [str(path.relative_to(output)) for path in output.rglob(".writing-*")]
    return f"left behind: {hidden}" if hidden else ""


@contextmanager
def clusters(engine: str, port: int) -> Iterator[Cluster | None]:
    """A Dask cluster while it is needed."""
    if engine == "local":
        yield None
        return
    cluster = Cluster(port)
    try:
        cluster.start()
        yield cluster
    finally:
        cluster.stop()


def main() -> int:
    """Run the campaign."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument("--engine", choices=tuple(TARGETS), default="local")
    parser.add_argument("--runs", type=int, default=100)
    parser.add_argument("--rows", type=int, default=3)
    parser.add_argument("--stub", action="store_true", help="rows that only write files")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--port", type=int, default=18786)
    arguments = parser.parse_args()
    random.seed(arguments.seed)
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(130))  # the cluster ends with this process
    with tempfile.TemporaryDirectory() as place, clusters(arguments.engine, arguments.port) as cluster:
        folder = Path(place) / ("stub" if arguments.stub else "data")
        table = make_stub_table(folder, arguments.rows) if arguments.stub else make_table(folder, arguments.rows)
        output = Path(place) / "study"
        began = time.monotonic()
        if cohort(table, output, cluster).wait() != 0:
            raise SystemExit("the undisturbed run failed")
        whole, reference = time.monotonic() - began, numbers_of(output)
        kills: Counter[str] = Counter()
        faults = []
        for number in range(arguments.runs):
            target = TARGETS[arguments.engine][number % len(TARGETS[arguments.engine])]
            told: dict[str, Any] = {"target": NOTHING}
            while told["target"] == NOTHING:  # the run had ended by that moment
                told = disturbed(table, output, cluster, target, random.uniform(0.0, 0.8 * whole))
            kills[told["target"]] += 1
            wrong = fault(output, reference)
            if wrong or told["exit_codes"][-1] != 0:
                faults.append(told | {"fault": wrong})
            print(json.dumps({"run": number + 1} | told | {"fault": wrong}), file=sys.stderr, flush=True)
    summary = {
        "engine": arguments.engine,
        "runs": arguments.runs,
        "rows": arguments.rows,
        "stub": arguments.stub,
        "kills": dict(kills),
    }
    print(json.dumps(summary | {"undisturbed_s": round(whole, 1), "faults": faults}, indent=1))
    return 1 if faults else 0


if __name__ == "__main__":
    raise SystemExit(main())
