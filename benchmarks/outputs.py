"""Signals, full disks and hostile folders: what commands leave in a folder that holds another patient's outputs.

    python benchmarks/outputs.py [--runs 12] [--seed 1] [--folder DIR]

`palpate estimate` and `palpate mesh` of a small case, whose numbers are computed once: only the writing is repeated.
SIGKILL, SIGTERM, SIGINT and SIGHUP come `--runs` times each, over a whole run, while files are written, and while they
take their places. Every fsync, mkdir, link, rename and truncation is refused in turn, alone or with all after it; and
files may not grow beyond random sizes. In the place of each file lies a link, a pipe, a socket, a device ...

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
import stat
import tempfile
import time
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

import nibabel
import numpy as np

from palpate.case import read_case
from palpate.cli import main as palpate
from palpate.study import estimate, make_mesh, read_json

DOCUMENTS = {"estimate": "result.json", "mesh": "mesh.json"}
HIDDEN = (".palpate.lock", ".writing-outputs", "log.txt")
SIGNALS = (signal.SIGKILL, signal.SIGTERM, signal.SIGINT, signal.SIGHUP)
MOST_CHANGES = 60  # of a command
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


def line(command: str, root: Path, folder: Path) -> list[str]:
    """The command line of a run."""
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
            assert palpate([*line(command, root, root / place / command), "--set", f"id={who}"]) == 0


def contents(folder: Path) -> dict[str, str]:
    """Name -> digest of all files that count; of links, pipes and the like the kind."""
    found = {}
    for path in folder.rglob("*"):
        name, kind = path.relative_to(folder).as_posix(), path.lstat().st_mode
        if not name.startswith((*HIDDEN, "earlier-")) and not stat.S_ISDIR(kind):
            found[name] = hashlib.sha256(path.read_bytes()).hexdigest() if stat.S_ISREG(kind) else str(kind)
    return found


class Trials:
    """Runs in fresh folders with the other patient's outputs, counted and judged."""

    def __init__(self, root: Path) -> None:
        """Those of the case in `root`."""
        self.root, self.folder, self.outside = root, root / "trial" / "out", root / "outside"
        self.old, self.new = ({of: contents(root / place / of) for of in DOCUMENTS} for place in ("old", "new"))
        self.counts: dict[str, Counter[str]] = {}
        self.failures: list[str] = []
        self.outside.mkdir()
        (self.outside / "file").write_text("mine")

    def judge(self, kind: str, command: str, **how: Any) -> None:
        """One run; how: see `_run`, and `lay`: what is laid into the folder before."""
        lay = how.pop("lay", None)
        shutil.rmtree(self.folder, ignore_errors=True)
        shutil.copytree(self.root / "old" / command, self.folder)
        if lay:
            lay()
        before, laid = contents(self.outside), contents(self.folder)
        code, text = self._run(command, **how)
        found = "old" if lay and contents(self.folder) == laid else self._state(command, laid if lay else {})
        flaw = flaw_of(code, text, found)
        if not flaw and not lay:  # the same command again
            again = self._run(command), self._state(command, {})
            flaw = "" if again[0][0] == 0 and again[1] == "new" else f"the next run: {again}"
        if contents(self.outside) != before:
            flaw = "something outside was touched"
        self.failures += [f"{command}, {kind}: {flaw}"] if flaw else []
        self.counts.setdefault(kind, Counter()).update(["runs", f"code {code}, {found}"])

    def _run(self, command: str, prepare: Callable[[], object] | None = None, send: Any = None) -> tuple[int, str]:
        """Code and words of the command in a process of its own, which does `prepare` first; send: gets its number."""
        with tempfile.TemporaryFile() as words:
            child = os.fork()
            if child == 0:
                for stream in (1, 2):
                    os.dup2(words.fileno(), stream)
                signal.alarm(PATIENCE_S)
                code = 99
                try:
                    if prepare:
                        prepare()
                    code = palpate(line(command, self.root, self.folder))
                finally:
                    os._exit(code)
            if send:
                send(child)
            code = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
            words.seek(0)
            return code, words.read().decode(errors="replace").strip()

    def _state(self, command: str, laid: dict[str, str]) -> str:
        """`old`, `new`, `aside` or `mixed`; laid: what lay in the folder, and is of no run where it is not old."""
        old, new, document = self.old[command], self.new[command], DOCUMENTS[command]
        here = {name: of for name, of in contents(self.folder).items() if laid.get(name, old.get(name)) != of}
        kept = {name: of for name, of in contents(self.folder).items() if old.get(name) == of}
        if kept == old and not here:
            return "old"
        both = {**kept, **here}
        differ = [name for name in kept if new.get(name) != kept[name]]
        if document in here:
            files = {name: of["sha256"] for name, of in read_json(self.folder / document)["files"].items()}
            told = both.keys() == new.keys() and files == {name: of for name, of in both.items() if name != document}
            return "new" if told and not differ else "mixed"
        aside = any(contents(place) == old for place in self.folder.glob("earlier-*"))
        return "aside" if aside and not (differ and here) and document not in both else "mixed"


def flaw_of(code: int, text: str, found: str) -> str:
    """What is wrong with the end of a run; empty when nothing is."""
    if code == 130:
        wanted = {"old"} if "no file was changed" in text else {"new"}
    elif code in REFUSALS:
        wanted = {"aside"} if "are whole in" in text else {"old"}
    else:  # a signal before the first line of the command ends it as any program
        wanted = {0: {"new"}, -signal.SIGKILL: {"old", "new", "aside"}}.get(code, {"old"} if code < 0 else set())
    plain = text.startswith("palpate: ") and "\n" not in text if code > 0 else "Traceback" not in text
    return "" if found in wanted and plain and "bug" not in text else f"code {code}, {found}: {text[-400:]}"


def signals(trials: Trials, runs: int, rng: random.Random) -> None:
    """Each signal over a whole run, while files are written, and while they take their places."""
    for command, kind, turn in itertools.product(DOCUMENTS, SIGNALS, range(runs)):
        moment, longest = ((".", 1.0), (".writing-outputs", 0.1), ("earlier-*", 0.002))[turn % 3]

        def send(child: int, kind: signal.Signals = kind, moment: str = moment, longest: float = longest) -> None:
            """Wait for the moment."""
            overdue = time.monotonic() + 2.0
            while moment != "." and time.monotonic() < overdue and not any(trials.folder.glob(moment)):
                pass
            time.sleep(longest * rng.random())
            os.kill(child, kind)

        trials.judge(f"{kind.name}, from {moment}", command, send=send)


def refused(turn: int, *, alone: bool) -> None:
    """From here on the change of that number fails, alone or with all after it."""
    count = itertools.count()

    def wrapped(function: Callable[..., Any]) -> Callable[..., Any]:
        """The function, refused in its turn."""

        def call(*given: Any, **options: Any) -> Any:
            """Refuse or do it."""
            number = next(count)
            if number == turn or (number > turn and not alone):
                raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
            return function(*given, **options)

        return call

    for place, name in CHANGES:
        setattr(place, name, wrapped(getattr(place, name)))


def no_larger(size: int) -> None:
    """From here on no file grows beyond so many bytes."""
    signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, size))


def full_disks(trials: Trials, runs: int, rng: random.Random) -> None:
    """Each change refused; files of limited sizes."""
    for command, alone, turn in itertools.product(DOCUMENTS, (True, False), range(MOST_CHANGES)):
        kind = f"change refused{'' if alone else ' with all after it'}"
        trials.judge(kind, command, prepare=functools.partial(refused, turn, alone=alone))
    for command, _ in itertools.product(DOCUMENTS, range(runs)):
        trials.judge("files too large", command, prepare=functools.partial(no_larger, int(10 ** rng.uniform(1, 5.5))))


def hostile(trials: Trials) -> None:
    """Each kind in the place of each file."""
    kinds: dict[str, Callable[[Path], object]] = {
        "link to a file": lambda place: place.symlink_to(trials.outside / "file"),
        "link to a folder": lambda place: place.symlink_to(trials.outside),
        "link to nothing": lambda place: place.symlink_to(trials.outside / "nothing"),
        "link to itself": lambda place: place.symlink_to(place.name),
        "hard link": lambda place: place.hardlink_to(trials.outside / "file"),
        "pipe": os.mkfifo,
        "socket": lambda place: os.mknod(place, 0o666 | stat.S_IFSOCK),
        "folder": lambda place: (place / "deep").mkdir(parents=True),
    }
    if os.getuid() == 0:
        kinds["device"] = lambda place: os.mknod(place, 0o666 | stat.S_IFCHR, os.makedev(1, 7))  # /dev/full
    for command, (kind, one) in itertools.product(DOCUMENTS, kinds.items()):
        for name in sorted({*trials.new[command], *HIDDEN, "surfaces"}):

            def lay(place: Path = trials.folder / name, one: Callable[[Path], object] = one) -> None:
                """Put one in the place of what lies there."""
                if place.is_dir():
                    shutil.rmtree(place)
                place.unlink(missing_ok=True)
                place.parent.mkdir(exist_ok=True)
                one(place)

            trials.judge(kind, command, lay=lay)


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
