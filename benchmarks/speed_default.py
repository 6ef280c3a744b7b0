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

from palpate.phantoms import PelvisOptions, pelvis

__all__ = ["default_case"]

LAWS = ("linear", "neo-hookean")
FIELD_MM, QUICK_FIELD_MM = 140.0, 110.0


def default_case(seed: int, *, quick: bool) -> dict[str, Any]:
    """Seconds, peak memory (MB) and size of `palpate estimate` at default settings, under each law in a process."""
    found = {}
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        subprocess.run([sys.executable, __file__, name, str(seed), str(int(quick))], check=True)
        for law in LAWS:
            command = [sys.executable, "-m", "palpate", "estimate", str(folder / "case.toml"), "--quiet"]
            command += ["--set", f'mechanics.law="{law}"', "--output", str(folder / law)]
            command += ["--set", "mesh.edge_length_mm=10"] if quick else []
            began = time.perf_counter()
            _, status, used = os.wait4(subprocess.Popen(command).pid, 0)
            seconds = time.perf_counter() - began
            document = json.loads((folder / law / "result.json").read_text())
            found[law] = {
                "exit": os.waitstatus_to_exitcode(status),
                "dofs": document["mesh"]["dofs"],
                "seconds": round(seconds, 1),
                "peak_mb": round(used.ru_maxrss / 1024.0),
                "evaluations": document["counts"]["evaluations"],
                "factorisations": document["counts"]["factorisations"],
                "verdicts": {e["tissue"]: e["verdict"] for e in document["estimates"]},
            }
    return found


def _write(folder: Path, seed: int, *, quick: bool) -> None:
    """The images of the case, in a process of its own: their truth needs more memory than an estimate."""
    side = QUICK_FIELD_MM if quick else FIELD_MM
    scene = pelvis(PelvisOptions(seed=seed, field_mm=(side, max(side, 120.0), max(side, 120.0)), truth_edge_mm=4.0))
    write_case(folder, scene)


if __name__ == "__main__":
    _write(Path(sys.argv[1]), int(sys.argv[2]), quick=sys.argv[3] == "1")
