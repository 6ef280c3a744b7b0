"""Processes of our own that another one starts: where they look for modules, and how they ended.

What a child imports, every image that is read waits for: no library stands here.
"""

from __future__ import annotations

import os
import signal
import sys
from pathlib import Path


def environment_of_child() -> dict[str, str]:
    """The environment of a process of ours: our places to import from, and one thread."""
    places = os.pathsep.join(str(Path(place).resolve()) for place in sys.path if place)
    threads = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")
    return {**os.environ, **threads, "PYTHONPATH": places}


def name_of_end(code: int) -> str:
    """The signal, or the exit code, by which a process ended."""
    return {-int(number): number.name for number in signal.Signals}.get(code, f"exit code {code}")
