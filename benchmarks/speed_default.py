"""A whole default case, as a user runs it: a pelvis in a box of 140 mm, from label images on disk to the report."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

from cost import write_case

from palpate.phantoms import Noise, PelvisOptions, pelvis

__all__ = ["default_case", "other_signals"]

LAWS = ("linear", "neo-hookean")
FIELD_MM, QUICK_FIELD_MM = 140.0, 110.0
DEFAULT = "default"
HELD = (  # what the model leaves out known, and the frame held
    'domain.outer_boundary="fixed"',
    "discrepancy.heterogeneity_sd=0",
    "discrepancy.poisson_sd=0",
    "discrepancy.surface_offset_mm=0",
)
BODIES: dict[str, dict[str, Any]] = {
    DEFAULT: {},
    "small motion": {"filling_mm": 3.0},
    "bones": {"bones": True},
    "three tissues": {"tumour": True},
    "thick slices": {"spacing_mm": (1.0, 1.0, 4.0)},
    "noise": {"noise": Noise(surface_sd_mm=0.3, correlation_length_mm=6.0)},
    "far driver": {"moduli_kpa": {"prostate": 10.0}},  # as the surroundings, of which it is a part: the bladder is left
}


def default_case(seed: int, *, quick: bool) -> dict[str, Any]:
    """Seconds, peak memory (MB) and size of `palpate estimate` at default settings, under each law in a process.

    held: the same with what the model leaves out known, and the frame held; discrepancy_ratio: what these unknowns
    cost, in time. at_once: both laws side by side, two processes that share the machine.
    """
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        _make(folder, DEFAULT, seed, quick=quick)
        found: dict[str, Any] = {law: _ended(*_started(folder, law, quick=quick)) for law in LAWS}
        plain = {law: _ended(*_started(folder, law, quick=quick, held=True)) for law in LAWS}
        found["held"] = plain
        found["discrepancy_ratio"] = {law: round(found[law]["seconds"] / plain[law]["seconds"], 2) for law in LAWS}
        found["at_once"] = [_ended(*of) for of in [_started(folder, law, quick=quick) for law in LAWS]]
    return found


def other_signals(seed: int, *, quick: bool) -> dict[str, Any]:
    """The default case beside others of its size whose images tell more or less, under each law, in one run."""
    found: dict[str, Any] = {}
    for body in BODIES:
        with tempfile.TemporaryDirectory() as name:
            folder = Path(name)
            _make(folder, body, seed, quick=quick)
            found[body] = {law: _ended(*_started(folder, law, quick=quick)) for law in LAWS}
        for law, of in found[body].items():
            of["over_default"] = round(of["seconds"] / found[DEFAULT][law]["seconds"], 2)
    return found


def _make(folder: Path, body: str, seed: int, *, quick: bool) -> None:
    """The case's files, by a process of its own: their truth needs more memory than an estimate."""
    subprocess.run([sys.executable, __file__, str(folder), body, str(seed), str(int(quick))], check=True)


def _started(folder: Path, law: str, *, quick: bool, held: bool = False) -> tuple[subprocess.Popen[bytes], Path, float]:
    """An estimate of the case in a folder: its process, where it writes, when it began."""
    output = folder / (f"{law}-held" if held else law)
    command = [sys.executable, "-m", "palpate", "estimate", str(folder / "case.toml"), "--quiet"]
    command += [part for key in HELD if held for part in ("--set", key)]
    command += ["--set", f'mechanics.law="{law}"', "--output", str(output)]
    command += ["--set", "mesh.edge_length_mm=10"] if quick else []
    began = time.perf_counter()
    return subprocess.Popen(command, stdout=subprocess.DEVNULL), output, began


def _ended(process: subprocess.Popen[bytes], output: Path, began: float) -> dict[str, Any]:
    """What it has cost, once it has ended."""
    _, status, used = os.wait4(process.pid, 0)
    seconds = time.perf_counter() - began
    document = json.loads((output / "result.json").read_text())
    return {
        "exit": os.waitstatus_to_exitcode(status),
        "dofs": document["mesh"]["dofs"],
        "seconds": round(seconds, 1),
        "peak_mb": round(used.ru_maxrss / 1024.0),
        "evaluations": document["counts"]["evaluations"],
        "factorisations": document["counts"]["factorisations"],
        "verdicts": {e["tissue"]: e["verdict"] for e in document["estimates"]},
    }


def _write(folder: Path, body: str, seed: int, *, quick: bool) -> None:
    side = QUICK_FIELD_MM if quick else FIELD_MM
    field = (side, max(side, 120.0), max(side, 120.0))
    scene = pelvis(PelvisOptions(seed=seed, truth_edge_mm=4.0, **{"field_mm": field, **BODIES[body]}))
    write_case(folder, scene, unnamed=BODIES[body].get("moduli_kpa", ()))


if __name__ == "__main__":
    _write(Path(sys.argv[1]), sys.argv[2], int(sys.argv[3]), quick=sys.argv[4] == "1")
