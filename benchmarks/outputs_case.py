"""Shared by the campaigns on outputs: a small case, a folder with another patient's outputs, and their judgement.

A folder is *old* when its files are byte by byte those that lay there before the run, *new* when they are those of an
undisturbed run (times and the page's date aside), each listed with its hash and nothing of the old run beside them.
Logs are left out; so are the files of this run that the next one removes (`.palpate.lock`, `.writing-outputs`).
"""

from __future__ import annotations

import hashlib
import json
import os
import shutil
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import nibabel
import numpy as np

from palpate.errors import NotConverged
from palpate.report import write_failure_report
from palpate.study import failure_document, read_case, recover, strange_files, write_json

PALPATE = str(Path(sys.executable).with_name("palpate"))
COMMANDS = ("estimate", "mesh", "report", "init")
SPACING = 1.5
CASE = """
id = "bert"
[images]
before = "before.nii.gz"
after = ["after.nii.gz"]
[tissues.prostate]
label = 1
role = "estimate"
[tissues.rectum]
label = 2
role = "driver"
[tissues.surroundings]
label = "remaining"
role = "known"
youngs_modulus_kpa = 10.0
[mechanics]
law = "linear"
element = "P1"
[mesh]
edge_length_mm = 6.0
[driver]
modes = 6
learn_prior = false
[estimate]
start_ratios = [1.0]
bounds_ratio = [0.5, 4.0]
"""
UNSETTLED = ("report.html", "report-data.npz")  # they hold a date
HIDDEN = (".palpate.lock", ".writing-outputs")


@dataclass(frozen=True, slots=True)
class Bench:
    """The folder of the case, and for each command what lies in its output folder before and after."""

    root: Path

    def old(self, command: str) -> Path:
        """The folder that a trial begins with."""
        return self.root / "old" / command

    def new(self, command: str) -> Path:
        """The folder after an undisturbed run."""
        return self.root / "new" / command

    def arguments(self, command: str, output: Path) -> list[str]:
        """The command line of a trial."""
        images = [str(self.root / f"{name}.nii.gz") for name in ("before", "after")]
        return {
            "estimate": ["estimate", str(self.root / "case.toml"), "--output", str(output), "--quiet"],
            "mesh": ["mesh", str(self.root / "case.toml"), "--output", str(output), "--quiet"],
            "report": ["report", str(output), "--quiet"],
            "init": ["init", *images, "--output", str(output), "--quiet"],
        }[command]


def make_bench(root: Path) -> Bench:
    """Write the case, another patient's outputs, and the outputs of an undisturbed run."""
    bench = Bench(root)
    root.mkdir(parents=True, exist_ok=True)
    for name, shift, radius in (("before", 0.0, 4.0), ("after", 0.8, 6.0)):
        image = nibabel.Nifti1Image(_anatomy(shift, radius), np.diag([SPACING] * 3 + [1.0]))
        nibabel.save(image, root / f"{name}.nii.gz")
    (root / "case.toml").write_text(CASE)
    for command in COMMANDS:
        old, new = bench.old(command), bench.new(command)
        old.mkdir(parents=True, exist_ok=True)
        if command in ("estimate", "mesh"):
            others = ["--set", "id=anna", "--set", "mesh.edge_length_mm=5"]
            done = run([*bench.arguments(command, old), *others])
            assert done.returncode == 0, done.stderr
        if command == "report":
            _failed_estimate(bench, old)
        (old / "log.txt").unlink(missing_ok=True)
        shutil.copytree(old, new)
        done = run(bench.arguments(command, new))
        assert done.returncode == 0, done.stderr
    return bench


def run(arguments: list[str], **options: Any) -> subprocess.CompletedProcess[str]:
    """Palpate with these arguments, undisturbed."""
    return subprocess.run([PALPATE, *arguments], capture_output=True, text=True, check=False, **options)


def contents(folder: Path) -> dict[str, str]:
    """Name -> hash of all files that count; links, pipes and folders by their kind."""
    found = {}
    for path in sorted(folder.rglob("*")):
        name = path.relative_to(folder).as_posix()
        if name.split("/")[0] in HIDDEN or name == "log.txt" or (path.is_dir() and not path.is_symlink()):
            continue
        if path.is_symlink() or not path.is_file():
            found[name] = f"{os.lstat(path).st_mode:o}"
        else:
            found[name] = hashlib.sha256(path.read_bytes()).hexdigest()
    return found


def state(
    bench: Bench, command: str, folder: Path, *, left_out: tuple[str, ...] = (), others: dict[str, str] | None = None
) -> str:
    """`old`, `new`, or `mixed`.

    `left_out`: files of an undisturbed run that the run said it had to leave out; `others`: what lay in the folder and
    is no run's, which a run leaves as it was.
    """
    here = contents(folder)
    strange = (others or {}).keys() - contents(bench.old(command)).keys() - contents(bench.new(command)).keys()
    if any(here.pop(name, None) != (others or {})[name] for name in strange):
        return "mixed"
    if here == contents(bench.old(command)):
        return "old"
    wanted = {name: digest for name, digest in contents(bench.new(command)).items() if name not in left_out}
    loose = {"result.json", "mesh.json", "preview.html"}  # times
    loose |= {*UNSETTLED, "model.npz"} if command == "estimate" else set()  # and a seal
    if {n: d for n, d in here.items() if n not in loose} != {n: d for n, d in wanted.items() if n not in loose}:
        return "mixed"
    return "new" if here.keys() == wanted.keys() and _sound(bench.new(command), folder) else "mixed"


def recovered(folder: Path) -> bool:
    """Do what the next run in the folder does first; whether there was something to do."""
    hidden = folder / ".writing-outputs"
    cut = (hidden / "ready").exists() or any(path.is_file() for path in (hidden / "old").rglob("*"))
    recover(folder)
    return cut


def leftovers(folder: Path) -> list[str]:
    """Hidden files that no run should leave."""
    return [path.name for path in folder.iterdir() if path.name.startswith(".")]


def _sound(reference: Path, folder: Path) -> bool:
    """Whether the documents list the files beside them and say what those of the undisturbed run say."""
    for name in ("result.json", "mesh.json"):
        if not (reference / name).exists():
            continue
        ours, theirs = (json.loads((place / name).read_text()) for place in (folder, reference))
        if name == "result.json" and strange_files(folder, ours["files"]):
            return False
        ours["warnings"] = [warning for warning in ours["warnings"] if warning["code"] != "report"]
        for document in (ours, theirs):
            for key in ("seconds", "files"):
                document.pop(key)
        if ours != theirs:
            return False
    return True


def _anatomy(shift: float, radius: float) -> np.ndarray[Any, np.dtype[np.uint8]]:
    """Labels (26, 26, 26): 1 a ball behind 2, a tube that fills."""
    places = np.stack(np.meshgrid(*[np.arange(26) * SPACING] * 3, indexing="ij"), axis=-1)
    labels = (np.linalg.norm(places - [19.0, 25.0 + shift, 19.0], axis=-1) < 10.0).astype(np.uint8)
    labels[np.linalg.norm(places[..., :2] - [19.0, 9.0], axis=-1) < radius] = 2
    return np.asarray(labels)


def _failed_estimate(bench: Bench, folder: Path) -> None:
    """The outputs of an estimate that did not converge, whose page is quick to draw; the page there is an old one."""
    case, error = read_case(bench.root / "case.toml"), NotConverged("stopped after 40 steps")
    write_failure_report(case, error, folder)
    (folder / "report.html").write_text("an older page")
    files = {name: {"sha256": hashlib.sha256((folder / name).read_bytes()).hexdigest()} for name in UNSETTLED}
    write_json(folder / "result.json", failure_document(case, error) | {"files": files})
