"""Damage cases, --set values and label tables at random: each must end in an error message of its class.

    python benchmarks/fuzz_cases.py --runs 1000000 --commands 4000 --output fuzz_cases.json

The seed is fixed. A run makes one damaged input (`spoilt_cases.py`) and reads it with the functions that the command
line calls. `--commands` cases go through `palpate check` itself, in their own process, and through `palpate estimate`
up to where solving begins. These are findings: an exception that is no `PalpateError`; an exit code of another class; a
message with control characters, several lines or over 2000 letters; a traceback; the request to report a bug; more than
2 s of processor time; different answers of `check` and `estimate`. Prints JSON.
"""

from __future__ import annotations

import argparse
import faulthandler
import importlib
import json
import os
import random
import resource
import sys
import tempfile
import time
import traceback
import warnings
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import NoReturn

import nibabel
import numpy as np
from spoilt_cases import CASES, NAMES, override, spoilt_case, spoilt_table, toml_of

from palpate.case import read_case
from palpate.cli import main as palpate_command
from palpate.errors import PalpateError
from palpate.images import read_label_table

importlib.import_module("palpate.study.check")  # before processes are forked that would import it each
ESTIMATE = importlib.import_module("palpate.study.run")

MEMORY_BYTES = 2 * 2**30
MOST_FINDINGS = 20
LONGEST_SENTENCE = 2000
SLOW_SECONDS = 2.0  # of processor time
COMMAND_SECONDS = 60  # of processor time of one `palpate check`, which reads images and predicts the cost
CASE_CODES, TABLE_CODES, COMMAND_CODES = {2}, {2, 3}, {0, 2, 3, 4, 6}


@dataclass(frozen=True, slots=True)
class Outcome:
    """Class name of what came out, seconds (a command: of processor time), and what should not have been."""

    kind: str
    seconds: float
    flaw: str = ""


def outcome(read: Callable[[], object], codes: set[int]) -> Outcome:
    """Read one spoilt input; `codes`: the exit codes that its refusal may have."""
    began = time.perf_counter()
    kind, flaw = read_once(read, codes)
    seconds = time.perf_counter() - began
    if seconds > SLOW_SECONDS:  # or the machine was busy: processor time decides, which takes long to read
        began = time.thread_time()
        read_once(read, codes)
        seconds = time.thread_time() - began
    return Outcome(kind, seconds, flaw or ("slow" if seconds > SLOW_SECONDS else ""))


def read_once(read: Callable[[], object], codes: set[int]) -> tuple[str, str]:
    """Class name of what comes out, and what should not have been."""
    try:
        read()
    except PalpateError as error:
        sentence, flaw = str(error), ""
        if error.exit_code not in codes:
            flaw = f"exit code {error.exit_code}: {sentence}"
        if "bug" in sentence or not sentence.isprintable() or len(sentence) > LONGEST_SENTENCE:
            flaw = f"{len(sentence)} letters: {sentence[:300]!r}"
        return type(error).__name__, flaw
    except Exception as error:
        return f"foreign {type(error).__name__}", traceback.format_exc(limit=-3)[-2000:]
    return "read", ""


def one_run(rng: random.Random, folder: Path) -> tuple[str, Outcome, bytes]:
    """Make one spoilt input and read it: what it was, what came of it, its text."""
    kind = rng.choice(("case", "case", "set", "table"))
    path = folder / "case.toml"
    if kind == "case":
        content = spoilt_case(rng)
        path.write_bytes(content)
        return kind, outcome(lambda: read_case(path), CASE_CODES), content
    if kind == "set":
        path.write_text(toml_of(rng.choice(CASES), random.Random(0)), encoding="utf-8")
        arguments = [override(rng) for _ in range(rng.choice((1, 1, 1, 2, 5)))]
        return kind, outcome(lambda: read_case(path, arguments), CASE_CODES), repr(arguments).encode()
    ending, content = spoilt_table(rng)
    table = folder / f"names{ending}"
    table.write_bytes(content)
    path.write_text(toml_of(CASES[1], random.Random(0)), encoding="utf-8")
    case = read_case(path, [f'tissues.prostate.label="{rng.choice(("prostate", "prostata", "x" * 200))}"'])
    return kind, outcome(lambda: case.resolve_tissues(read_label_table(table)), TABLE_CODES), content


def command_run(rng: random.Random, folder: Path) -> tuple[str, Outcome, bytes]:
    """`palpate check` on one spoilt case whose images are there; an estimate must refuse it alike."""
    content = spoilt_case(rng, CASES[:2])
    (folder / "case.toml").write_bytes(content)
    (folder / "names.json").write_text(json.dumps(NAMES))
    arguments = [word for _ in range(rng.choice((0, 0, 1))) for word in ("--set", override(rng))]
    if any("\0" in word or "phantom" in word for word in arguments) or b"phantom" in content:
        arguments = []  # no argument of a process holds a zero byte, and phantoms take minutes
    case, out = str(folder / "case.toml"), str(folder / "out")
    code, words, seconds = said_by(["check", case, "--quiet", *arguments], folder)
    wrong = code not in COMMAND_CODES or "Traceback" in words or "report it" in words or (code != 0) != bool(words)
    flaw = f"exit code {code}: {words[-1000:]}" if wrong else ""
    slow = "slow" if seconds > SLOW_SECONDS and code == 2 else ""
    ended, sentence, _ = said_by(["estimate", case, "--output", out, "--quiet", *arguments], folder)
    if not flaw and (ended != code or sentence.strip().removeprefix("palpate: ") not in words):
        flaw = f"check ends with {code}: {words[-500:]}; estimate with {ended}: {sentence[-500:]}"
    return "command", Outcome(f"exit code {code}", seconds, flaw or slow), content + repr(arguments).encode()


def said_by(argv: list[str], folder: Path) -> tuple[int, str, float]:
    """Exit code, words and processor time (s) of a command in a process of its own."""
    with (folder / "said.txt").open("w+b") as said:
        pid = os.fork()
        if pid == 0:
            become_command(argv, said.fileno())
        _, status, usage = os.wait4(pid, 0)
        said.seek(0)
        words = said.read().decode("utf-8", errors="replace")
    return os.waitstatus_to_exitcode(status), words, usage.ru_utime + usage.ru_stime


def become_command(argv: list[str], said: int) -> None:
    """The forked process: run `palpate` with these arguments under limits, say everything into `said`, and end.

    An estimate ends where it begins to solve.
    """
    code = 99
    try:
        os.dup2(said, 1)
        os.dup2(said, 2)
        sys.stdout, sys.stderr = os.fdopen(1, "w"), os.fdopen(2, "w")
        resource.setrlimit(resource.RLIMIT_CPU, (COMMAND_SECONDS, COMMAND_SECONDS))
        warnings.simplefilter("default")
        vars(ESTIMATE)["inverted"] = solving_begins
        try:
            code = palpate_command(argv)
        except SystemExit as stop:
            code = stop.code if isinstance(stop.code, int) else 98
        sys.stdout.flush()
        sys.stderr.flush()
    finally:
        os._exit(code)


def solving_begins(*_arguments: object, **_options: object) -> NoReturn:
    """Instead of an inversion."""
    raise SystemExit(0)


def save_images(folder: Path) -> None:
    """A ball (1) behind a tube (2) that fills, in two label images."""
    places_mm = np.stack(np.meshgrid(*[np.arange(20) * 2.0] * 3, indexing="ij"), axis=-1)
    for name, shift, radius in (("before", 0.0, 4.0), ("after", 0.8, 6.0)):
        labels = (np.linalg.norm(places_mm - [19.0, 25.0 + shift, 19.0], axis=-1) < 10.0).astype(np.uint8)
        labels[np.linalg.norm(places_mm[..., :2] - [19.0, 9.0], axis=-1) < radius] = 2
        nibabel.save(nibabel.Nifti1Image(labels, np.diag([2.0, 2.0, 2.0, 1.0])), folder / f"{name}.nii.gz")


def campaign(runs: int, commands: int, seed: int, folder: Path) -> dict[str, object]:
    """All runs; the document to be printed."""
    rng = random.Random(seed)
    save_images(folder)
    kinds: dict[str, Counter[str]] = {kind: Counter() for kind in ("case", "set", "table", "command")}
    findings: list[dict[str, str]] = []
    slowest = dict.fromkeys(kinds, 0.0)
    began, before = time.perf_counter(), peak_mebibytes()
    for number in range(runs + commands):
        kind, result, content = (one_run if number < runs else command_run)(rng, folder)
        kinds[kind][result.kind] += 1
        slowest[kind] = max(slowest[kind], result.seconds)
        if result.flaw and len(findings) < MOST_FINDINGS and result.flaw not in {f["flaw"] for f in findings}:
            shown = content[:3000].decode("utf-8", errors="backslashreplace")
            findings.append({"kind": kind, "run": str(number), "flaw": result.flaw, "input": shown})
    return {
        "runs": runs,
        "commands": commands,
        "seed": seed,
        "seconds": round(time.perf_counter() - began, 1),
        "outcomes": {kind: dict(sorted(counts.items())) for kind, counts in kinds.items()},
        "findings": findings,
        "slowest_seconds": {kind: round(seconds, 3) for kind, seconds in slowest.items()},
        "memory_limit_mib": MEMORY_BYTES // 2**20,
        "peak_memory_mib": peak_mebibytes(),
        "memory_before_mib": before,
    }


def peak_mebibytes() -> int:
    """Largest resident size of this process so far, MiB."""
    scale = 2**20 if sys.platform == "darwin" else 2**10
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss // scale


def main() -> int:
    """Run the campaign; exit code 1 when something was found."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--runs", type=int, default=1_000_000)
    parser.add_argument("--commands", type=int, default=4000)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--output", type=Path)
    arguments = parser.parse_args()
    faulthandler.enable()
    warnings.simplefilter("error")
    _, hard = resource.getrlimit(resource.RLIMIT_AS)
    resource.setrlimit(resource.RLIMIT_AS, (MEMORY_BYTES, hard))
    memory_disk = Path("/dev/shm")
    with tempfile.TemporaryDirectory(dir=memory_disk if memory_disk.is_dir() else None) as folder:
        document = campaign(arguments.runs, arguments.commands, arguments.seed, Path(folder))
    text = json.dumps(document, indent=1)
    if arguments.output:
        arguments.output.write_text(text + "\n", encoding="utf-8")
    print(text)
    return 1 if document["findings"] else 0


if __name__ == "__main__":
    sys.exit(main())
