"""Signals, full disks and hostile folders: what commands leave in a folder that holds another patient's outputs.

    python benchmarks/outputs.py [--runs 12] [--seed 1] [--folder DIR]

`palpate estimate` and `palpate mesh` of a small case, whose numbers are computed once: only the writing is repeated.
SIGKILL, SIGTERM, SIGINT and SIGHUP come `--runs` times each, over a whole run, while files are written, and while they
take their places. Every fsync, mkdir, link, rename and truncation is refused in turn, alone or with all after it; and
files may not grow beyond `--runs` random sizes. In the place of each file lies a link, a pipe, a socket, a device ...

The folder must hold the old files, or the new ones, or (after SIGKILL, or where even undoing is refused) the old ones
whole in `earlier-...` and no document. The last words must fit that, in one sentence. The same command must then
succeed. Nothing outside the folder may change. Prints counts as JSON; `failures` must be empty.
"""

from __future__ import annotations

import argparse
import errno
import functools
import hashlib
import importlib
import itertools
import json
import os
import random
import resource
import shutil
import signal
import socket
import tempfile
import time
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

import nibabel
import numpy as np

from palpate.cli import main as palpate
from palpate.study import read_case, read_json
from palpate.study.run import estimate, make_mesh

DOCUMENTS = {"estimate": "result.json", "mesh": "mesh.json"}
HIDDEN = (".palpate.lock", ".writing-outputs")
LATE = ("log.txt", "surfaces")  # further places for what is hostile
SIGNALS = (signal.SIGKILL, signal.SIGTERM, signal.SIGINT, signal.SIGHUP)
CHANGES = ((Path, "mkdir"), (Path, "replace"), (os, "link"), (os, "fsync"), (os, "ftruncate"))
REFUSALS, PATIENCE_S = (2, 3, 6), 60
CASE = """
id = "bert"
[images]
before = "before.nii.gz"
after = ["after.nii.gz"]
[tissues]
prostate = {label = 1, role = "estimate"}
rectum = {label = 2, role = "driver"}
surroundings = {label = "remaining", role = "known", youngs_modulus_kpa = 10.0}
[mechanics]
law = "linear"
element = "P1"
[driver]
modes = 6
learn_prior = false
[estimate]
start_ratios = [1.0]
bounds_ratio = [0.5, 4.0]
"""


def nothing() -> None:
    """What is done to most runs."""


def arguments(command: str, root: Path, folder: Path) -> list[str]:
    """The command line."""
    overwrite = ["--overwrite"] if command == "estimate" else []
    return [command, str(root / "case.toml"), "--output", str(folder), "--quiet", *overwrite]


def make(root: Path) -> None:
    """The case, what its commands compute from here on, and the outputs of another patient of the same numbers."""
    places = np.stack(np.meshgrid(*[np.arange(26) * 1.5] * 3, indexing="ij"), axis=-1)
    for name, shift, radius in (("before", 0.0, 4.0), ("after", 0.8, 6.0)):
        labels = (np.linalg.norm(places - [19.0, 25.0 + shift, 19.0], axis=-1) < 10.0).astype(np.uint8)
        labels[np.linalg.norm(places[..., :2] - [19.0, 9.0], axis=-1) < radius] = 2
        nibabel.save(nibabel.Nifti1Image(labels, np.diag([1.5, 1.5, 1.5, 1.0])), root / f"{name}.nii.gz")
    (root / "case.toml").write_text(CASE)
    run: Any = importlib.import_module("palpate.study.run")
    report: Any = importlib.import_module("palpate.report.case_report")
    report.render = lambda data, **_: f"the page of {data.document['id']}"
    for place, who, edge in (("old", "anna", 7), ("new", "bert", 6)):
        case = read_case(root / "case.toml", [f"id={who}", f"mesh.edge_length_mm={edge}"])
        estimated, meshed = estimate(case), make_mesh(case)
        run.estimate, run.make_mesh = lambda *_, e=estimated, **__: e, lambda *_, m=meshed, **__: m
        for command in DOCUMENTS:
            assert palpate([*arguments(command, root, root / place / command), "--set", f"id={who}"]) == 0


def contents(folder: Path) -> dict[str, str]:
    """Name -> content of all files that count; of links and pipes the kind."""
    found = {}
    for path in sorted(folder.rglob("*")) if os.path.lexists(folder) else ():
        name = path.relative_to(folder).as_posix()
        hidden = name.split("/")[0] in HIDDEN or name == "log.txt" or name.startswith("earlier-")
        if not hidden and (path.is_symlink() or not path.is_dir()):
            plain = path.is_file() and not path.is_symlink()
            found[name] = hashlib.sha256(path.read_bytes()).hexdigest() if plain else f"{path.lstat().st_mode:o}"
    return found


def state(command: str, root: Path, folder: Path, others: dict[str, str]) -> str:
    """`old`, `new`, `aside` or `mixed`; others: what lies there and is of no run."""
    old, new, here = contents(root / "old" / command), contents(root / "new" / command), contents(folder)
    here = {name: of for name, of in here.items() if others.get(name) != of}
    if here == old:
        return "old"
    if DOCUMENTS[command] in here:
        files = {name: of["sha256"] for name, of in read_json(folder / DOCUMENTS[command])["files"].items()}
        whole = here.keys() == new.keys() and files == {n: of for n, of in here.items() if n != DOCUMENTS[command]}
        undone = [name for name in new if new[name] != old.get(name) and here.get(name) == old.get(name)]
        return "new" if whole and not undone else "mixed"
    ours = {here[name] == old.get(name) for name in here if new.get(name) != old.get(name)}
    aside = any(contents(place) == old for place in folder.glob("earlier-*"))
    return "aside" if aside and len(ours) < 2 else "mixed"


def run(command: str, root: Path, folder: Path, prepare: Callable[[], object] = nothing, send: Any = None) -> Any:
    """Code and words of the command in a process of its own; send: is told its number, once."""
    with tempfile.TemporaryFile() as words:
        child = os.fork()
        if child == 0:
            for stream in (1, 2):
                os.dup2(words.fileno(), stream)
            signal.alarm(PATIENCE_S)
            code = 99
            try:
                prepare()
                code = palpate(arguments(command, root, folder))
            finally:
                os._exit(code)
        if send is not None:
            send(child)
        code = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
        words.seek(0)
        return code, words.read().decode(errors="replace").strip()


def flaw_of(code: int, text: str, found: str) -> str:
    """What is wrong with the end of a run; empty when nothing is."""
    if code == 130:
        wanted, said = ("old",) if "no file was changed" in text else ("new",), text.startswith("palpate: interrupted")
    elif code in REFUSALS:
        wanted, said = ("aside",) if "are whole in" in text else ("old",), text.startswith("palpate: ")
    else:  # a signal before the first line of the command ends it as any program
        wanted = {0: ("new",), -signal.SIGKILL: ("old", "new", "aside")}.get(code, ("old",) if code < 0 else ())
        said = True
    lines = len(text.splitlines())
    fine = found in wanted and said and (lines == 1 if code > 0 else "bug" not in text and "Traceback" not in text)
    return "" if fine else f"code {code}, the folder is {found}: {text[-400:]}"


class Trials:
    """Runs that are counted and judged, each in a fresh folder."""

    def __init__(self, root: Path) -> None:
        """Those of the case in `root`."""
        self.root, self.folder, self.outside = root, root / "trial" / "out", root / "outside"
        self.counts: dict[str, Counter[str]] = {}
        self.failures: list[str] = []
        self.outside.mkdir()
        (self.outside / "file").write_text("mine")

    def judge(self, kind: str, command: str, lay: Callable[[], object] = nothing, **how: Any) -> None:
        """One run after `lay`."""
        shutil.rmtree(self.folder, ignore_errors=True)
        shutil.copytree(self.root / "old" / command, self.folder)
        before, old = contents(self.outside), contents(self.folder)
        lay()
        others = {name: of for name, of in contents(self.folder).items() if old.get(name) != of}
        code, text = run(command, self.root, self.folder, **how)
        found = state(command, self.root, self.folder, others)
        if lay is not nothing and code in REFUSALS:
            found = "old" if others.items() <= contents(self.folder).items() <= (old | others).items() else "mixed"
        flaw = flaw_of(code, text, found)
        if lay is nothing and not flaw:  # the same command again
            again = run(command, self.root, self.folder)
            now = state(command, self.root, self.folder, {})
            flaw = "" if (again[0], now) == (0, "new") else f"again: {again}, {now}"
        if contents(self.outside) != before:
            flaw = "something outside was touched"
        self.failures += [f"{command}, {kind}: {flaw}"] if flaw else []
        self.counts.setdefault(kind, Counter()).update(["runs", f"code {code}, {found}"])


def signals(trials: Trials, runs: int, rng: random.Random) -> None:
    """Each signal over a whole run, while files are written, and while they take their places."""
    for command, kind, turn in itertools.product(DOCUMENTS, SIGNALS, range(runs)):
        moment = ("any", ".writing-outputs", "earlier-*")[turn % 3]

        def send(child: int, moment: str = moment, kind: signal.Signals = kind) -> None:
            """Wait for the moment."""
            overdue = time.monotonic() + (rng.random() if moment == "any" else 2.0)
            while time.monotonic() < overdue and (moment == "any" or not list(trials.folder.glob(moment))):
                time.sleep(0.0)
            time.sleep(0.0 if moment == "any" else rng.random() ** 2 * (0.1 if moment.startswith(".") else 0.002))
            os.kill(child, kind)

        trials.judge(f"{kind.name}, {moment}", command, send=send)


def refused(turn: int, folder: Path, *, alone: bool) -> None:
    """From here on the change of that number below the folder fails, alone or with all after it."""
    count = itertools.count()

    def wrapped(function: Callable[..., Any]) -> Callable[..., Any]:
        """The function, refused in its turn."""

        def call(place: Any, *rest: Any, **options: Any) -> Any:
            """Refuse or do it."""
            path = str(Path(f"/proc/self/fd/{place}").readlink()) if isinstance(place, int) else str(place)
            number = next(count) if path.startswith(str(folder)) else -1
            if number == turn or (number > turn and not alone):
                (folder.parent / "refused").touch()
                raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
            return function(place, *rest, **options)

        return call

    (folder.parent / "refused").unlink(missing_ok=True)
    for place, name in CHANGES:
        setattr(place, name, wrapped(getattr(place, name)))


def no_larger(size: int) -> None:
    """From here on no file grows beyond so many bytes."""
    signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, size))


def full_disks(trials: Trials, runs: int, rng: random.Random) -> None:
    """Each change refused; files of limited sizes."""
    for command, alone in itertools.product(DOCUMENTS, (True, False)):
        for turn in itertools.count():
            prepare = functools.partial(refused, turn, trials.folder, alone=alone)
            trials.judge(f"refused {'alone' if alone else 'with all after it'}", command, prepare=prepare)
            if not (trials.folder.parent / "refused").exists():
                break
    for command, _ in itertools.product(DOCUMENTS, range(runs)):
        trials.judge("files too large", command, prepare=functools.partial(no_larger, int(10 ** rng.uniform(1, 5.5))))


def a_socket(place: Path) -> None:
    """A socket's file."""
    with socket.socket(socket.AF_UNIX) as server:
        server.bind(str(place))


def hostile(trials: Trials) -> None:
    """Each kind in the place of each file."""
    kinds: dict[str, Callable[[Path], object]] = {
        "link to a file": lambda place: place.symlink_to(trials.outside / "file"),
        "link to a folder": lambda place: place.symlink_to(trials.outside),
        "link to nothing": lambda place: place.symlink_to(trials.outside / "nothing"),
        "link to itself": lambda place: place.symlink_to(place.name),
        "hard link": lambda place: place.hardlink_to(trials.outside / "file"),
        "pipe": os.mkfifo,
        "socket": a_socket,
        "folder": lambda place: (place / "deep").mkdir(parents=True),
    }
    if os.getuid() == 0:
        kinds["device"] = lambda place: os.mknod(place, 0o020666, os.makedev(1, 7))  # /dev/full
    for command, (kind, make_one) in itertools.product(DOCUMENTS, kinds.items()):
        for name in {*contents(trials.root / "new" / command), *HIDDEN, *LATE}:

            def lay(place: Path = trials.folder / name, make_one: Callable[[Path], object] = make_one) -> None:
                """Put it in the place of what lies there."""
                if place.is_dir():
                    shutil.rmtree(place)
                place.unlink(missing_ok=True)
                place.parent.mkdir(exist_ok=True)
                make_one(place)

            trials.judge(kind, command, lay)


def main() -> None:
    """Print the counts."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--runs", type=int, default=12)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--folder", type=Path)
    options = parser.parse_args()
    rng = random.Random(options.seed)
    with tempfile.TemporaryDirectory(dir=options.folder) as folder:
        make(Path(folder))
        trials = Trials(Path(folder))
        signals(trials, options.runs, rng)
        full_disks(trials, options.runs, rng)
        hostile(trials)
    runs = sum(counts["runs"] for counts in trials.counts.values())
    print(json.dumps({"runs": runs, "kinds": trials.counts, "failures": trials.failures}, indent=1))


if __name__ == "__main__":
    main()
