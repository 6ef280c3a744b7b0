"""Hostile output folders: nothing outside may be touched, and every run must end with an exit code and a sentence.

    python benchmarks/outputs_hostile.py [--runs 2] [--seed 1] [--folder DIR]

In the place of each file that `palpate estimate`, `mesh`, `report` and `init` write, of their lock, log and hidden
folder, lies a link (to a file, to a folder, to nothing, to itself), a hard link, a pipe, a socket, a device, a folder
or a file that may not be written; `--runs` times each, with a random choice of further ones. Then folders of strange
names: too long, with control characters, not UTF-8. The numbers are computed once; only the writing is repeated.
A run must end with 0 and the new files, or be refused (2, 3, 6) with one sentence and leave everything as it was.
Prints counts as JSON; `failures` must be empty.
"""

from __future__ import annotations

import argparse
import json
import os
import random
import shutil
import signal
import socket
import tempfile
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

from outputs_case import COMMANDS, Bench, contents, leftovers, make_bench, state
from outputs_full_disk import compute

import palpate.cli

HIDDEN = (".palpate.lock", ".writing-outputs", ".writing-outputs/new", "log.txt", "surfaces", "report.html.earlier")
NAMES = (
    "n" * 255,
    "n" * 256,
    "a/" * 2100,
    "line\nbreak",
    "\x1b[2J",
    "\udcff\udcfe",
    "-",
    "--json",
    "~root",
    " ",
    "\u202egnp",
)
REFUSALS = (2, 3, 6)
PATIENCE = 60  # s; a pipe must not hold a run


def a_socket(place: Path) -> None:
    """A socket's file."""
    with socket.socket(socket.AF_UNIX) as server:
        where = os.open(place.parent, os.O_RDONLY)
        server.bind(f"/proc/self/fd/{where}/{place.name}")
        os.close(where)


def kinds(outside: Path) -> dict[str, Callable[[Path], object]]:
    """What may lie in the place of a file."""
    found: dict[str, Callable[[Path], object]] = {
        "link to a file": lambda place: place.symlink_to(outside / "file"),
        "link to a folder": lambda place: place.symlink_to(outside),
        "link to nothing": lambda place: place.symlink_to(outside / "nothing"),
        "link to itself": lambda place: place.symlink_to(place.name),
        "hard link": lambda place: place.hardlink_to(outside / "file"),
        "pipe": os.mkfifo,
        "socket": a_socket,
        "folder": Path.mkdir,
        "folder that holds something": lambda place: (place / "deep").mkdir(parents=True),
        "file that may not be written": a_file_that_may_not_be_written,
    }
    if os.getuid() == 0:
        found["device"] = lambda place: os.mknod(place, 0o020666, os.makedev(1, 7))  # /dev/full
    return found


def a_file_that_may_not_be_written(place: Path) -> None:
    """What only its owner may read."""
    place.write_text("mine")
    place.chmod(0o400)


def attempt(bench: Bench, command: str, folder: Path, outside: Path) -> tuple[int, str, str]:
    """Run the command in a process of its own: its code, its words, and what is wrong (nothing: empty)."""
    before, there = contents(outside), contents(folder) if is_folder(folder) else {}
    with tempfile.TemporaryFile() as words:
        pid = os.fork()
        if pid == 0:
            os.dup2(words.fileno(), 2)
            os.dup2(words.fileno(), 1)
            signal.alarm(PATIENCE)
            code = 99
            try:
                code = palpate.cli.main(bench.arguments(command, folder))
            finally:
                os._exit(code)
        code = os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1])
        words.seek(0)
        text = words.read().decode(errors="replace")
    flaw = ""
    if contents(outside) != before:
        flaw = "something outside was touched"
    elif "Traceback" in text or "bug" in text or code not in (0, *REFUSALS):
        flaw = "no sentence"
    elif code and len(text.strip().splitlines()) != 1:
        flaw = "not one sentence"
    elif code and is_folder(folder) and contents(folder) != there:
        flaw = "a refused run has changed the folder"
    elif code == 0 and set(leftovers(folder)) - {".palpate.lock"}:
        flaw = f"left behind: {leftovers(folder)}"
    elif code == 0 and state(bench, command, folder, others=there) != "new":
        flaw = f"the folder is {state(bench, command, folder, others=there)}"
    return code, text, flaw


def is_folder(place: Path) -> bool:
    """Whether there is a folder of that name, which may be one that no folder can have."""
    try:
        return place.is_dir()
    except OSError:
        return False


def spoilt(bench: Bench, command: str, runs: int, rng: random.Random) -> list[dict[str, Any]]:
    """Each kind in each place."""
    outside, folder = bench.root / "outside", bench.root / "trial" / "out"
    seen = []
    names = sorted({path.name for path in bench.new(command).iterdir()} | set(HIDDEN))
    for name in names:
        for kind, make in kinds(outside).items():
            for k in range(runs):
                shutil.rmtree(folder, ignore_errors=True)
                shutil.copytree(bench.old(command), folder)
                places = [(name, make), *(random_place(rng, names, outside) for _ in range(k))]
                for place, lay in places:
                    lay_in(folder / place, lay)
                code, text, flaw = attempt(bench, command, folder, outside)
                seen.append({"command": command, "kind": kind, "code": code})
                if flaw:
                    seen[-1]["failure"] = f"{command}, {name} a {kind} ({k} more): {flaw} ({code}): {text[-400:]}"
    return seen


def random_place(rng: random.Random, names: list[str], outside: Path) -> tuple[str, Callable[[Path], object]]:
    """A name and what lies there."""
    return rng.choice(names), rng.choice(list(kinds(outside).values()))


def lay_in(place: Path, lay: Callable[[Path], object]) -> None:
    """Put it in the place of what lies there."""
    if place.is_dir() and not place.is_symlink():
        shutil.rmtree(place)
    elif os.path.lexists(place):
        place.unlink()
    if not os.path.lexists(place.parent):
        place.parent.mkdir()
    if place.parent.is_dir() and not place.parent.is_symlink():
        lay(place)


def strange_names(bench: Bench, command: str) -> list[dict[str, Any]]:
    """Folders whose names are hard to make or to print."""
    seen = []
    for name in NAMES if command != "report" else ():
        folder = bench.root / "names" / command / name
        code, text, flaw = attempt(bench, command, folder, bench.root / "outside")
        flaw = flaw if flaw in ("", "something outside was touched", "no sentence", "not one sentence") else ""
        seen.append({"command": command, "kind": "strange name", "code": code})
        if flaw:
            seen[-1]["failure"] = f"{command}, folder {name[:30]!r}: {flaw} ({code}): {text[-400:]}"
    return seen


def main() -> None:
    """Print the counts."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--runs", type=int, default=2)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--folder", type=Path)
    arguments = parser.parse_args()
    rng = random.Random(arguments.seed)
    with tempfile.TemporaryDirectory() as temporary:
        bench = make_bench((arguments.folder or Path(temporary)) / "hostile")
        (bench.root / "outside").mkdir()
        (bench.root / "outside" / "file").write_text("mine")
        compute(bench)
        seen = [one for c in COMMANDS for one in spoilt(bench, c, arguments.runs, rng) + strange_names(bench, c)]
    codes: dict[str, Counter[str]] = {}
    for one in seen:
        codes.setdefault(one["kind"], Counter()).update(["runs", f"code {one['code']}"])
    failures = [one["failure"] for one in seen if "failure" in one]
    print(json.dumps({"runs": len(seen), "kinds": codes, "failures": failures}, indent=1))


if __name__ == "__main__":
    main()
