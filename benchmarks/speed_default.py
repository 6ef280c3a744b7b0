"""A whole default case, as a user runs it: a pelvis in a box of 140 mm, from label images on disk to the report."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from cost import write_case
from scipy.ndimage import gaussian_filter

from palpate.mesh import located, point_interpolation
from palpate.phantoms import Noise, PelvisOptions, Scene, pelvis

__all__ = ["default_case", "mapped_organ", "measured_field", "other_signals"]

LAWS = ("linear", "neo-hookean")
FIELD_MM, QUICK_FIELD_MM = 140.0, 110.0
DEFAULT = "default"
HELD = (  # what the model leaves out known, and the frame held
    'domain.outer_boundary="fixed"',
    "discrepancy.heterogeneity_sd=0",
    "discrepancy.poisson_sd=0",
    "discrepancy.surface_offset_mm=0",
)
N_POINTS = 100_000  # of a measured field, on a lattice
FIELD_SD_MM, ALIKE_MM = 0.5, 5.0  # of its errors
MAPPED, MODES, QUICK_MODES = "prostate", 1000, 100
LARGE_EDGE_MM = 5.4  # 104 k unknowns
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
    """The default case and others of its size with more or less information, under each law, in one run."""
    found: dict[str, Any] = {}
    for body in BODIES:
        with tempfile.TemporaryDirectory() as name:
            folder = Path(name)
            _make(folder, body, seed, quick=quick)
            found[body] = {law: _ended(*_started(folder, law, quick=quick)) for law in LAWS}
        for law, of in found[body].items():
            of["over_default"] = round(of["seconds"] / found[DEFAULT][law]["seconds"], 2)
    return found


def measured_field(seed: int, *, quick: bool) -> dict[str, Any]:
    """The default case by its surfaces alone and with a field of 100 000 points, under each law, and their ratios."""
    found: dict[str, Any] = {}
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        _make(folder, DEFAULT, seed, quick=quick)
        for law in LAWS:
            alone = _ended(*_started(folder, law, quick=quick))
            beside = _ended(*_started(folder, law, quick=quick, case="field.toml"))
            ratios = {f"{key}_ratio": round(beside[key] / alone[key], 2) for key in ("seconds", "peak_mb")}
            found[law] = {"surfaces": alone, "field": beside, **ratios}
    return found


def mapped_organ(seed: int, *, quick: bool) -> dict[str, Any]:
    """The case with a field of 100 000 points, the prostate's modulus as one and as a map, under each law."""
    found: dict[str, Any] = {"modes_asked": QUICK_MODES if quick else MODES}
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        _make(folder, DEFAULT, seed, quick=quick)
        text, one = (folder / "field.toml").read_text(), f'"{MAPPED}" = {{'
        mapped = text.replace(one, f'{one}modulus = "field", field_modes = {found["modes_asked"]}, ')
        (folder / "map.toml").write_text(mapped)
        edge = () if quick else (f"mesh.edge_length_mm={LARGE_EDGE_MM}",)
        for law in LAWS:
            alone = _ended(*_started(folder, law, quick=quick, case="field.toml", settings=edge))
            beside = _ended(*_started(folder, law, quick=quick, case="map.toml", settings=edge))
            keys = ("seconds", "processor_s", "peak_mb")
            ratios = {f"{key}_ratio": round(beside[key] / alone[key], 2) for key in keys}
            found[law] = {"one modulus": alone, "map": beside, **ratios}
    return found


def _make(folder: Path, body: str, seed: int, *, quick: bool) -> None:
    """The case's files, by a process of its own: their truth needs more memory than an estimate."""
    subprocess.run([sys.executable, __file__, str(folder), body, str(seed), str(int(quick))], check=True)


def _started(
    folder: Path,
    law: str,
    *,
    quick: bool,
    held: bool = False,
    case: str = "case.toml",
    settings: Sequence[str] = (),
) -> tuple[subprocess.Popen[bytes], Path, float]:
    """An estimate of a case in a folder: its process, where it writes, when it began."""
    output = folder / f"{law}-{Path(case).stem}{'-held' if held else ''}"
    command = [sys.executable, "-m", "palpate", "estimate", str(folder / case), "--quiet"]
    command += [part for key in (*settings, *(HELD if held else ())) for part in ("--set", key)]
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
        "processor_s": round(used.ru_utime + used.ru_stime, 1),
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
    if body == DEFAULT:
        _write_field(folder, scene)


def _write_field(folder: Path, scene: Scene) -> None:
    """A second case with a table of displacements on a lattice, whose errors are correlated in space."""
    low, high = scene.mesh.nodes.min(axis=0), scene.mesh.nodes.max(axis=0)
    spacing = float(np.prod(high - low) / N_POINTS) ** (1.0 / 3.0)
    n = np.ceil((high - low) / spacing).astype(int)
    axes = [a + (b - a) * (np.arange(k) + 0.5) / k for a, b, k in zip(low, high, n, strict=True)]
    lattice = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)
    errors = np.random.default_rng(scene.seed).standard_normal(lattice.shape)
    errors = gaussian_filter(errors, ALIKE_MM / spacing, axes=(0, 1, 2))
    places = located(scene.mesh, lattice.reshape(-1, 3))
    before = lattice.reshape(-1, 3)[places.inside]
    moved = point_interpolation(scene.space, places.of(places.inside)) @ scene.displacement
    after = before + moved + FIELD_SD_MM * (errors / errors.std()).reshape(-1, 3)[places.inside]
    names = ",".join(f"{state}_{axis}" for state in ("before", "after") for axis in "xyz")
    np.savetxt(folder / "field.csv", np.hstack([before, after]), fmt="%.4f", delimiter=",", header=names, comments="")
    kind = f'kind = "displacement-field"\nfile = "field.csv"\nsd_mm = {FIELD_SD_MM}\ncorrelation_mm = {ALIKE_MM}\n'
    (folder / "field.toml").write_text(f"{(folder / 'case.toml').read_text()}\n[[data]]\n{kind}")


if __name__ == "__main__":
    _write(Path(sys.argv[1]), sys.argv[2], int(sys.argv[3]), quick=sys.argv[4] == "1")
