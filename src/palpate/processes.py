"""Processes: the memory that is left for one, the environment of child processes, and how they ended.

Every process that reads an image imports this file, so it imports no library.
"""

from __future__ import annotations

import os
import re
import signal
import sys
from contextlib import suppress
from pathlib import Path

STATED = "PALPATE_MEMORY_GB"  # environment variable: memory for this program where others share the machine
MACHINE = Path("/proc/meminfo")
Groups = tuple[tuple[str, str, str], ...]
# Control groups, version 2 and 1, as a container sees its own: limit, use, and the name of its caches in memory.stat.
CGROUPS: Groups = (
    ("/sys/fs/cgroup/memory.max", "/sys/fs/cgroup/memory.current", "inactive_file"),
    (
        "/sys/fs/cgroup/memory/memory.limit_in_bytes",
        "/sys/fs/cgroup/memory/memory.usage_in_bytes",
        "total_inactive_file",
    ),
)


def available_memory(groups: Groups = CGROUPS, machine: Path = MACHINE) -> float | None:
    """Bytes that are free on this machine and under the control group's limit; None where the system does not say."""
    found = [_of_machine("MemAvailable:", machine), _stated()]
    for limit, use, caches in groups:
        with suppress(OSError, ValueError, IndexError):  # "max": no limit
            lines = Path(limit).with_name("memory.stat").read_text(encoding="ascii").splitlines()
            given_back = next((float(line.split()[1]) for line in lines if line.split()[0] == caches), 0.0)
            left = float(Path(limit).read_text(encoding="ascii")) - float(Path(use).read_text(encoding="ascii"))
            found.append(left + given_back)
    return min((amount for amount in found if amount is not None), default=None)


def total_memory(groups: Groups = CGROUPS, machine: Path = MACHINE) -> float | None:
    """Bytes of this machine, or the control group's limit, free or not; None where the system does not say.

    It does not depend on other programs, so decisions by it are the same in every run.
    """
    found = [_of_machine("MemTotal:", machine), _stated()]
    for limit, _, _ in groups:
        with suppress(OSError, ValueError):  # "max": no limit
            found.append(float(Path(limit).read_text(encoding="ascii")))
    return min((amount for amount in found if amount is not None), default=None)


def _stated() -> float | None:
    """Bytes that the environment allows this program; None where that is no plain number."""
    stated = os.environ.get(STATED, "")
    return 1e9 * float(stated) if re.fullmatch(r"[0-9]{1,6}(\.[0-9]{1,6})?", stated) else None


def _of_machine(line: str, machine: Path) -> float | None:
    try:
        lines = machine.read_text(encoding="ascii").splitlines()
        return next(float(found.split()[1]) for found in lines if found.startswith(line)) * 1024.0
    except (OSError, StopIteration, ValueError):
        return None


def environment_of_child() -> dict[str, str]:
    """The environment of a child process: the same import path, and one thread of linear algebra."""
    places = os.pathsep.join(str(Path(place).resolve()) for place in sys.path if place)
    threads = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")
    return {**os.environ, **threads, "PYTHONPATH": places}


def name_of_end(code: int) -> str:
    """The signal that ended a process, or its exit code, in words."""
    return {-int(number): number.name for number in signal.Signals}.get(code, f"exit code {code}")
