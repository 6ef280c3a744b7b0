"""Shared by all parts of the export check: lines of its table, tissues' volumes, and which programs are installed."""

from __future__ import annotations

import importlib
import subprocess
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

import palpate
from palpate.mesh import TetMesh

Results = dict[tuple[str, str], palpate.CaseResult]  # by law, and element or "turned"

VOLUME = 1e-4
LPS = np.array([-1.0, -1.0, 1.0])


@dataclass(frozen=True)
class Row:
    """A line of the table: what was checked by which program, its figure and the limit for it; None: not installed."""

    part: str
    what: str
    figure: float | None
    limit: float
    unit: str = ""

    @property
    def kept(self) -> bool:
        """Whether the limit is kept, or nothing was checked."""
        return self.figure is None or self.figure <= self.limit

    @property
    def text(self) -> str:
        """The figure, as it stands in the table."""
        return "not installed" if self.figure is None else f"{self.figure:.2g} {self.unit}".strip()


def missing(part: str, what: str) -> Iterator[Row]:
    """The line of a program that is not installed."""
    yield Row(part, what, None, 0)


def any_of(results: Results) -> palpate.CaseResult:
    """The neo-Hookean result with plain quadratic elements, on which formats are checked."""
    return results["neo-hookean", "P2"]


def volumes_of(mesh: TetMesh) -> dict[str, float]:
    """Volume of each meshed tissue, mm^3."""
    regions = {t.name: i for i, t in enumerate(mesh.tissues) if t.meshed}
    return {name: float(mesh.volumes[mesh.region == i].sum()) for name, i in regions.items()}


def worst_volume(found: dict[str, float], mesh: TetMesh) -> float:
    """Largest relative difference of a tissue's volume; infinite where one is missing."""
    expected = volumes_of(mesh)
    return max(abs(found.get(name, np.inf) / size - 1.0) for name, size in expected.items())


def tetrahedra(points: NDArray[np.float64], cells: NDArray[np.int64]) -> float:
    """Volume of tetrahedra by their corners, mm^3."""
    corner = points[cells[:, :4]]
    return float(np.linalg.det(corner[:, 1:] - corner[:, :1]).sum() / 6.0)


def percent(found: NDArray[np.float64], expected: NDArray[np.float64]) -> float:
    """RMS over the nodes of the distance of two vectors, in per cent of the largest that is expected."""
    distance = np.linalg.norm(found - expected, axis=1)
    return float(100.0 * np.sqrt((distance**2).mean()) / np.linalg.norm(expected, axis=1).max())


def installed(name: str) -> Any:
    """The module of that name; None where it is not installed."""
    try:
        return importlib.import_module(name)
    except ImportError:
        return None


def ran(command: Sequence[str | Path], folder: Path) -> str:
    """What a program prints that ends well; raises `RuntimeError` with it where it does not."""
    done = subprocess.run(
        [str(word) for word in command], cwd=folder, capture_output=True, text=True, check=False, timeout=1800
    )
    if done.returncode:
        raise RuntimeError(f"{command[0]} ended with {done.returncode}: {(done.stdout + done.stderr)[-2000:]}")
    return done.stdout + done.stderr
