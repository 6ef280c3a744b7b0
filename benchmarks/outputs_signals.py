"""Signals at random moments of a run: the folder must hold the old files or the new ones, and a rerun must succeed.

    python benchmarks/outputs_signals.py [--runs 104] [--seed 1] [--workers 2] [--folder DIR]

For each of SIGKILL, SIGTERM, SIGINT and SIGHUP, `--runs` runs of `palpate estimate`, `mesh`, `report` and `init` into a
folder with another patient's outputs. A third of the signals come at a moment drawn over the whole of a run, from the
start of its process; a third while files are staged, and a third while they take their places, in runs whose numbers
are known beforehand, so that they only write. SIGINT and SIGHUP reach the whole process group, as from a terminal. A
run that SIGKILL cut is first completed as the next run would; where the old files are left, the same command runs again
and must give what it gives undisturbed. Prints counts as JSON; `failures` must be empty.
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
import os
import random
import shutil
import signal
import sys
import tempfile
import time
from collections import Counter
from dataclasses import dataclass
from pathlib import Path

from outputs_case import PALPATE, Bench, leftovers, make_bench, recovered, run, state
from outputs_full_disk import compute

import palpate.cli

SIGNALS = (signal.SIGKILL, signal.SIGTERM, signal.SIGINT, signal.SIGHUP)
SHARES = {"estimate": 1, "mesh": 3, "report": 3, "init": 6}  # a quick command is run more often
MOMENTS = ("any", "staging", "renames")
PATIENCE = 300.0
WRITING = 0.5  # s of an estimate whose numbers and page are known


@dataclass(frozen=True, slots=True)
class Trial:
    """One run: which command, which signal, when (`share`: of the run's or the stage's duration), and its number."""

    number: int
    command: str
    signal: signal.Signals
    moment: str
    share: float


def trials(runs: int, seed: int) -> list[Trial]:
    """The same for each seed."""
    rng = random.Random(seed)
    found = list[Trial]()
    for kind in SIGNALS:
        weights = [command for command, weight in SHARES.items() for _ in range(weight)]
        for k in range(runs):
            command = weights[k % len(weights)]
            found.append(Trial(len(found), command, kind, MOMENTS[(k // len(weights)) % 3], rng.random()))
    return found


def attempt(bench: Bench, trial: Trial, seconds: dict[str, float]) -> dict[str, str]:
    """Run it; what was seen, with the key `failure` where a law is broken."""
    folder = bench.root / "trials" / f"{trial.number}"
    shutil.copytree(bench.old(trial.command), folder)
    process = Run(bench.arguments(trial.command, folder), writes_only=trial.moment != "any")
    wait_for(trial, process, folder, seconds[trial.command])
    running = process.code is None
    if running:
        process.send(trial.signal)
    code, out, err = process.end()
    seen = {"signal": trial.signal.name, "command": trial.command, "moment": trial.moment}
    seen["cut"] = str(recovered(folder)) if trial.signal is signal.SIGKILL else "False"
    seen["state"] = state(bench, trial.command, folder)
    seen["end"] = end_of(trial, code, err, running=running)
    flaw = flaw_of(trial, seen, out, err, code)
    if not flaw and seen["state"] == "old":
        again, _, err = Run(bench.arguments(trial.command, folder), writes_only=trial.moment != "any").end()
        if again or state(bench, trial.command, folder) != "new" or leftovers(folder):
            flaw = f"the rerun ended with {again}, {leftovers(folder)}: {err[-500:]}"
    if flaw:
        seen["failure"] = f"trial {trial.number}: {flaw}"
    else:
        shutil.rmtree(folder)
    return seen


class Run:
    """A run of Palpate in a process group of its own; one that `writes_only` is a copy of this process."""

    def __init__(self, arguments: list[str], *, writes_only: bool) -> None:
        """Start it."""
        self._words = tempfile.TemporaryFile(), tempfile.TemporaryFile()  # noqa: SIM115 - they live as long as the run
        self._code: int | None = None
        self._pid = os.fork()
        if self._pid == 0:
            os.setpgid(0, 0)
            for number, file in zip((1, 2), self._words, strict=True):
                os.dup2(file.fileno(), number)
            for number in SIGNALS[1:]:
                signal.signal(number, signal.default_int_handler if number == signal.SIGINT else signal.SIG_DFL)
            if not writes_only:
                os.execv(PALPATE, [PALPATE, *arguments])
            sys.argv = [PALPATE, *arguments]
            code = 99
            try:
                code = palpate.cli.main()
            finally:
                os._exit(code)

    @property
    def code(self) -> int | None:
        """How it ended; None while it works."""
        if self._code is None:
            pid, status = os.waitpid(self._pid, os.WNOHANG)
            self._code = os.waitstatus_to_exitcode(status) if pid else None
        return self._code

    def send(self, number: signal.Signals) -> None:
        """A signal, to the group where a terminal would send it there."""
        (os.killpg if number in (signal.SIGINT, signal.SIGHUP) else os.kill)(self._pid, number)

    def end(self) -> tuple[int, str, str]:
        """Wait for its end: the code, and what it said on standard output and standard error."""
        overdue = time.monotonic() + PATIENCE
        while self.code is None:
            time.sleep(0.002)
            if time.monotonic() > overdue:
                os.killpg(self._pid, signal.SIGKILL)
        for file in self._words:
            file.seek(0)
        out, err = (file.read().decode(errors="replace") for file in self._words)
        return int(self.code or 0), out, err


def wait_for(trial: Trial, process: Run, folder: Path, seconds: float) -> None:
    """Until the moment of the signal."""
    hidden = folder / ".writing-outputs"
    if trial.moment == "any":
        time.sleep(trial.share * seconds)
        return
    seconds = WRITING
    watched = hidden if trial.moment == "staging" else hidden / "ready"
    while process.code is None and not watched.exists():
        time.sleep(0.0002)
    longest = {"estimate": 0.4 * seconds, "mesh": 0.05, "report": 0.02, "init": 0.005}[trial.command]
    time.sleep(trial.share**2 * longest if trial.moment == "staging" else trial.share * 0.002)


def end_of(trial: Trial, code: int, err: str, *, running: bool) -> str:
    """How the run ended, in a word."""
    if not running or code == 0:
        return "finished"
    if code == 130:
        return "interrupted, new files" if "taken their places" in err or "is written" in err else "interrupted"
    if code == -signal.SIGKILL:
        return "killed"
    # From its first line on Palpate blocks the signals, then answers them: none can end it as the system does.
    as_any_program = code == -trial.signal and (not err or trial.signal is signal.SIGINT) and ", in main" not in err
    return "before the first line" if as_any_program else f"code {code}"


def flaw_of(trial: Trial, seen: dict[str, str], out: str, err: str, code: int) -> str:
    """What is wrong with the end of a run; empty when nothing is."""
    lines = err.strip().splitlines()
    wanted = {
        "finished": ("new",),
        "interrupted": ("old",),
        "interrupted, new files": ("new",),
        "killed": ("old", "new"),
    }
    if seen["end"] == "before the first line":
        return "" if seen["state"] == "old" else f"{seen['state']} before the first line"
    if seen["end"] not in wanted or (seen["end"] == "killed") != (trial.signal is signal.SIGKILL and code != 0):
        return f"ended with {seen['end']}: {err[-500:]}"
    if seen["state"] not in wanted[seen["end"]]:
        return f"{seen['end']}, but the folder is {seen['state']}: {err[-500:]}"
    if code == 130 and (out or len(lines) != 1 or not lines[0].startswith("palpate: interrupted")):
        return f"not one sentence: {err[-500:]}"
    return f"a traceback: {err[-500:]}" if "Traceback" in err or "bug" in err else ""


def main() -> None:
    """Print the counts."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--runs", type=int, default=104)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--folder", type=Path)
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as temporary:
        bench = make_bench((arguments.folder or Path(temporary)) / "signals")
        seconds = {}
        for command in SHARES:
            folder = shutil.copytree(bench.old(command), bench.root / "timed" / command)
            began = time.monotonic()
            run(bench.arguments(command, folder))
            seconds[command] = time.monotonic() - began
        chosen = trials(arguments.runs, arguments.seed)
        random.Random(arguments.seed).shuffle(chosen)
        compute(bench)
        with multiprocessing.get_context("fork").Pool(arguments.workers) as pool:
            seen = pool.starmap(
                attempt, [(bench, trial, seconds) for trial in chosen], chunksize=1
            )  # a trial that waits for its moment keeps no other waiting
    print(json.dumps(summary(seen), indent=1))


def summary(seen: list[dict[str, str]]) -> dict[str, object]:
    """Counts by signal and by command."""

    def counts(key: str) -> dict[str, dict[str, int]]:
        """By what `key` says: the runs, how they ended, and what the folder held."""
        groups: dict[str, Counter[str]] = {}
        for one in seen:
            group = groups.setdefault(one[key], Counter())
            group.update(["runs", one["end"], f"folder {one['state']}"])
            group.update(["cut among the renames"] if one["cut"] == "True" else [])
        return {name: dict(sorted(group.items())) for name, group in sorted(groups.items())}

    failures = [one["failure"] for one in seen if "failure" in one]
    return {"runs": len(seen), "signals": counts("signal"), "commands": counts("command"), "failures": failures}


if __name__ == "__main__":
    main()
