"""A disk that is full at the n-th operation, for every n: the output folder must hold the old files or the new ones.

    python benchmarks/outputs_full_disk.py [--runs 60] [--seed 1] [--folder DIR]

`palpate estimate`, `mesh`, `report` and `init` work in a folder with another patient's outputs. Their numbers are
computed once; only the writing is repeated. First, every write, fsync, mkdir, truncation and rename in the folder
fails in turn with ENOSPC (a failing write leaves half of what it should), alone or with all after it; the counts of
bytes show that no write of theirs goes by unseen. Then, where tmpfs may be mounted, `--runs` runs of each with a
random rest of space. Each must end with 0 and the new files (an estimate: or all but its page, which it says), or with
6, one sentence and the old files. Prints counts as JSON; `failures` must be empty.
"""

from __future__ import annotations

import argparse
import builtins
import errno
import importlib
import io
import json
import os
import random
import shutil
import subprocess
import sys
import tempfile
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from outputs_case import COMMANDS, UNSETTLED, Bench, contents, leftovers, make_bench, recovered, state

import palpate.cli.entry
from palpate.study import read_case

SPACE = 32 * 2**20  # bytes of the small disk
PAGE = 4096
# modules whose functions are replaced by ones that return the known answer
RUN: Any = importlib.import_module("palpate.study.run")
NEW_CASE: Any = importlib.import_module("palpate.study.new_case")
CASE_REPORT: Any = importlib.import_module("palpate.report.case_report")


@dataclass(slots=True)
class Disk:
    """Counts the operations below `folder`, and refuses the one of number `turn`, alone or with all after it."""

    folder: str
    turn: int
    alone: bool
    operations: int = 0
    written: int = 0
    refused: list[str] = field(default_factory=list)

    def full(self, what: str, place: object) -> bool:
        """Whether this operation fails."""
        path = path_of(place)
        if not path.startswith(self.folder):
            return False
        number = self.operations
        self.operations += 1
        if number == self.turn or (number > self.turn >= 0 and not self.alone):
            self.refused.append(f"{what} {path}")
            return True
        return False


def path_of(place: object) -> str:
    """The path of a file that is given as one, or by its number."""
    if isinstance(place, int):
        return str(Path(f"/proc/self/fd/{place}").readlink())
    return os.fsdecode(place) if isinstance(place, str | bytes | os.PathLike) else ""


def install(disk: Disk) -> None:
    """Put the disk between Python and the system, for good."""

    class File(io.FileIO):
        """A file whose writes may fail."""

        def write(self, content: Any) -> int:
            """Write, or half of it and fail."""
            if disk.full("write", self.fileno()):
                super().write(bytes(content)[: len(content) // 2])
                raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
            disk.written += len(content)
            return int(super().write(content) or 0)

    first = io.open

    def opened(file: Any, mode: str = "r", buffering: int = -1, *rest: Any, **options: Any) -> Any:
        """As `open`, on our files where it writes."""
        if not set(mode) & set("wax+"):
            return first(file, mode, buffering, *rest, **options)
        raw = File(file, mode.replace("b", "").replace("t", ""), options.get("closefd", True), options.get("opener"))
        if buffering == 0:
            return raw
        buffered = io.BufferedRandom(raw) if "+" in mode else io.BufferedWriter(raw)
        if "b" in mode:
            return buffered
        names = ("encoding", "errors", "newline")
        return io.TextIOWrapper(buffered, **dict(zip(names, rest, strict=False)), **{
            name: options[name] for name in names if name in options
        })  # fmt: skip

    builtins.open = io.open = opened
    for name in ("write", "fsync", "mkdir", "ftruncate", "rename", "replace"):
        setattr(os, name, refusing(disk, name, getattr(os, name)))


def refusing(disk: Disk, name: str, function: Callable[..., Any]) -> Callable[..., Any]:
    """`function` of the module os, which fails when the disk is full."""

    def call(place: Any, *arguments: Any, **options: Any) -> Any:
        """Refuse or do it."""
        if disk.full(name, place):
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        if name == "write":
            disk.written += len(arguments[0]) if path_of(place).startswith(disk.folder) else 0
        return function(place, *arguments, **options)

    return call


def compute(bench: Bench) -> None:
    """Let estimate, mesh, page and guess of the case be known from here on."""
    case = read_case(bench.root / "case.toml")
    estimated, meshed = RUN.estimate(case), RUN.make_mesh(case)
    images = [bench.root / f"{name}.nii.gz" for name in ("before", "after")]
    guess = NEW_CASE.new_case(NEW_CASE.CaseImages(images[0], (images[1],)), bench.new("init"))
    pages: dict[str, str] = {}
    first: Callable[..., str] = CASE_REPORT.render

    def render(data: Any, **options: Any) -> str:
        """The page, drawn once for each state of a result."""
        return pages.setdefault(data.document["status"], first(data, **options))

    with tempfile.TemporaryDirectory() as folder:
        collected = CASE_REPORT.collect(estimated)
        CASE_REPORT.render = render
        CASE_REPORT.collect = lambda _: collected
        CASE_REPORT.write_case_report(estimated, Path(folder))
    CASE_REPORT.render = lambda data, **options: pages.get(data.document["status"]) or first(data, **options)
    RUN.estimate = lambda *_, **__: estimated
    RUN.make_mesh = lambda *_, **__: meshed
    NEW_CASE.new_case = lambda *_: guess


def attempt(bench: Bench, command: str, folder: Path, disk: Disk) -> dict[str, Any]:
    """Run the command in a process of its own, and judge what it left."""
    with tempfile.TemporaryFile() as err, tempfile.TemporaryFile() as told:
        pid = os.fork()
        if pid == 0:
            os.dup2(err.fileno(), 2)
            os.dup2(err.fileno(), 1)
            if disk.folder:
                install(disk)
            code = 99
            try:
                code = palpate.cli.main(bench.arguments(command, folder))
            finally:
                told.write(json.dumps([disk.operations, disk.written, disk.refused]).encode())
                told.flush()
                os._exit(code)
        code = os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1])
        err.seek(0)
        told.seek(0)
        text, (operations, written, refused) = err.read().decode(), json.loads(told.read())
    recovered(folder)
    gone = missing(bench, command, folder)
    left_out = UNSETTLED if "report.html" in gone else ("preview.html",) if gone == {"preview.html"} else ()
    seen = {"state": state(bench, command, folder, left_out=left_out), "code": code, "page": not left_out}
    seen |= {"operations": operations, "written": written, "refused": refused}
    flaw = flaw_of(command, folder, seen, text)
    return seen | ({"failure": f"{command}, {refused[:1]}: {flaw}"} if flaw else {})


def missing(bench: Bench, command: str, folder: Path) -> set[str]:
    """Files of an undisturbed run that are not there."""
    return {path.name for path in bench.new(command).iterdir() if not (folder / path.name).exists()}


def flaw_of(command: str, folder: Path, seen: dict[str, Any], text: str) -> str:
    """What is wrong; empty when nothing is."""
    lines = text.strip().splitlines()
    if "Traceback" in text or "bug" in text or seen["code"] not in (0, 6):
        return f"ended with {seen['code']}: {text[-600:]}"
    whole = ("completes them", "case.toml is written, but not what shows it")  # by the next run; but for the preview
    completed = seen["code"] == 6 and seen["state"] == "new" and any(words in text for words in whole)
    if seen["state"] == "mixed" or ((seen["state"] == "new") != (seen["code"] == 0) and not completed):
        return f"code {seen['code']}, but the folder is {seen['state']}: {text[-600:]}"
    if seen["code"] == 6 and len(lines) != 1:
        return f"not one sentence: {text[-600:]}"
    if not seen["page"] and seen["state"] == "new":
        said = command == "init" and completed
        said |= command == "estimate" and '"code": "report"' in (folder / "result.json").read_text()
        return "" if said else "the page is missing without a word"
    return f"left {leftovers(folder)}" if leftovers(folder) else ""


def refused_operations(bench: Bench, folder: Path) -> Iterator[dict[str, Any]]:
    """Every operation of every command in turn."""
    for command in COMMANDS:
        for alone in (True, False):
            turn = -1
            while True:
                shutil.rmtree(folder, ignore_errors=True)
                shutil.copytree(bench.old(command), folder)
                seen = attempt(bench, command, folder, Disk(str(folder), turn, alone))
                if turn < 0:
                    seen["unseen_bytes"] = max(size_of(folder, bench.old(command)) - seen["written"], 0)
                yield seen | {"command": command, "kind": "alone" if alone else "with all after it"}
                if turn >= 0 and not seen["refused"]:
                    break
                turn += 1


def size_of(folder: Path, old: Path | None = None) -> int:
    """Bytes of the files in a folder that are not as they were in `old`."""
    earlier = contents(old) if old else {}
    names = [name for name, digest in contents(folder).items() if earlier.get(name) != digest]
    return sum((folder / name).stat().st_size for name in names)


def small_disks(bench: Bench, folder: Path, runs: int, seed: int) -> Iterator[dict[str, Any]]:
    """Each command with a random rest of space on a disk of its own."""
    rng = random.Random(seed)
    with mounted(folder) as there:
        for command in COMMANDS if there else ():
            needed = size_of(bench.new(command)) + 64 * PAGE
            for _ in range(runs):
                for place in folder.iterdir():
                    shutil.rmtree(place) if place.is_dir() else place.unlink()
                shutil.copytree(bench.old(command), folder / "out")
                rest = rng.randrange(0, needed, PAGE)
                free = os.statvfs(folder).f_bavail * PAGE
                with (folder / "filler").open("wb") as file:
                    os.posix_fallocate(file.fileno(), 0, free - rest)
                yield attempt(bench, command, folder / "out", Disk("", -1, alone=True)) | {
                    "command": command,
                    "kind": "small disk",
                }


@contextmanager
def mounted(folder: Path) -> Iterator[bool]:
    """A small disk at `folder`, if the system lets us."""
    folder.mkdir()
    command = ["mount", "-t", "tmpfs", "-o", f"size={SPACE}", "tmpfs", str(folder)]
    there = (
        shutil.which("mount") is not None and subprocess.run(command, capture_output=True, check=False).returncode == 0
    )
    try:
        yield there
    finally:
        if there:
            subprocess.run(["umount", str(folder)], check=True)


def main() -> None:
    """Print the counts."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--runs", type=int, default=60)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--folder", type=Path)
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as temporary:
        root = arguments.folder or Path(temporary)
        bench = make_bench(root / "disk")
        compute(bench)
        sys.stdout.flush()
        seen = list(refused_operations(bench, bench.root / "trial" / "out"))
        seen += small_disks(bench, bench.root / "small", arguments.runs, arguments.seed)
    counts: dict[str, Counter[str]] = {}
    for one in seen:
        end = f"code {one['code']}, {one['state']}" + (
            "" if one["page"] or one["state"] == "old" else " without its page"
        )
        counts.setdefault(f"{one['command']}, {one['kind']}", Counter()).update(["runs", end])
    unseen = sum(one.get("unseen_bytes", 0) for one in seen)
    failures = [one["failure"] for one in seen if "failure" in one]
    document = {"runs": len(seen), "counts": counts, "bytes_that_no_shim_saw": unseen, "failures": failures}
    print(json.dumps(document, indent=1))


if __name__ == "__main__":
    main()
