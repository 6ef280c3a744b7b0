"""What every simulator's file has: the named parts of a fitted body, and rows of numbers as lines of text."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from palpate.images.tissue import Role
from palpate.mesh.surface import tissue_surface
from palpate.mesh.tet_mesh import FACES, OUTER, TetMesh
from palpate.study.outputs import write_text

STEP = 0.05  # of ln E, between the materials of a tissue that is not homogeneous
MOST_LETTERS = 80  # of a plain name
OFF = float(np.expm1(0.5 * STEP))  # of a modulus, that an element has less or more than its material, at the most


def rows(pattern: str, *columns: NDArray[Any]) -> str:
    """A line a row of `columns`, each (n,) or (n, k), by a `%` pattern with a place for each number."""
    parts = [column[:, None] if column.ndim == 1 else column for column in columns]
    cells = [list(map(tuple, part.tolist())) for part in parts]
    return "".join(f"{pattern % sum(row, ())}\n" for row in zip(*cells, strict=True))


def write_script(path: Path) -> None:
    """Write the script of that name, one of export/scripts, to `path`; raises `ResourceError` when the disk refuses."""
    script = resources.files("palpate.export") / "scripts" / f"{path.name}.txt"
    write_text(path, script.read_text(encoding="utf-8"))


def wrapped(numbers: NDArray[np.int64]) -> str:
    """Numbers (n,) with commas between them, twelve on a line."""
    lines = [numbers[start : start + 12].tolist() for start in range(0, len(numbers), 12)]
    return "".join(f"{', '.join(map(str, line))}\n" for line in lines)


@dataclass(frozen=True, slots=True)
class FaceGroup:
    """Faces of a mesh under a name: triangles (n, 3) node numbers, normals out of the tissue (into a hollow one's)."""

    name: str
    triangles: NDArray[np.int64]


def tissue_groups(mesh: TetMesh) -> dict[str, NDArray[np.int64]]:
    """Numbers (n,) of the tetrahedra of each meshed tissue by its name."""
    return {
        tissue.name: np.flatnonzero(mesh.region == number)
        for number, tissue in enumerate(mesh.tissues)
        if tissue.meshed
    }


@dataclass(frozen=True, slots=True)
class MaterialPart:
    """Elements of a tissue with one modulus: its name, the tissue's number, cells (n,), ln E over the tissue's."""

    name: str
    tissue: int
    cells: NDArray[np.int64]
    log_ratio: float


def material_parts(mesh: TetMesh, log_ratio: NDArray[np.float64] | None) -> tuple[MaterialPart, ...]:
    """The meshed tissues, those whose elements have other moduli by log_ratio (n_tets,) in parts of nearly one.

    The parts of a tissue are called as it is, with their number; a homogeneous tissue is one part of its own name.
    """
    found = list[MaterialPart]()
    for name, cells in tissue_groups(mesh).items():
        tissue = int(mesh.region[cells[0]])
        logs = np.zeros(len(cells)) if log_ratio is None else log_ratio[cells]
        step = np.rint(logs / STEP).astype(np.int64)
        kinds = np.unique(step)
        for number, kind in enumerate(kinds, start=1):
            called = name if len(kinds) == 1 else f"{name} part {number} of {len(kinds)}"
            found.append(MaterialPart(called, tissue, cells[step == kind], STEP * float(kind)))
    return tuple(found)


def face_groups(mesh: TetMesh) -> tuple[FaceGroup, ...]:
    """The surface of each meshed tissue, its observed part, each hollow tissue's wall, the cut of the image.

    Their names are the tissue's with " surface", " observed" or " wall", and "outer boundary". Empty ones are left out.
    """
    prescribed = [i for i, tissue in enumerate(mesh.tissues) if tissue.role in (Role.DRIVER, Role.RIGID)]
    found = []
    for number, tissue in enumerate(mesh.tissues):
        if not tissue.meshed:
            found.append(FaceGroup(f"{tissue.name} wall", mesh.boundary[mesh.beyond == number]))
            continue
        surface = tissue_surface(mesh, number)
        found.append(FaceGroup(f"{tissue.name} surface", surface.triangles))
        if tissue.role is Role.ESTIMATE:
            seen = ~np.isin(surface.other, [OUTER, *prescribed])
            found.append(FaceGroup(f"{tissue.name} observed", surface.triangles[seen]))
    found.append(FaceGroup("outer boundary", mesh.boundary[mesh.beyond == OUTER]))
    return tuple(group for group in found if len(group.triangles))


def element_faces(mesh: TetMesh, triangles: NDArray[np.int64]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Tetrahedron (n,) and its face (n,), a row of FACES, of triangles (n, 3) whose normals point out of it."""
    every, wanted = _turned(mesh.tets[:, FACES].reshape(-1, 3), len(mesh.nodes)), _turned(triangles, len(mesh.nodes))
    order = np.argsort(every)
    place = order[np.searchsorted(every, wanted, sorter=order)]
    return place // 4, place % 4


def plain_names(names: Iterable[str]) -> dict[str, str]:
    """Names of capital letters, digits and underscores, each its own, for programs that take no others."""
    found: dict[str, str] = {}
    for name in names:
        letters = "".join(c.upper() if c.isascii() and c.isalnum() else "_" for c in name)
        plain = (letters if letters[:1].isalpha() else f"T_{letters}")[: MOST_LETTERS - 6]
        taken, number = set(found.values()), 2
        unique = plain
        while unique in taken:
            unique, number = f"{plain}_{number}", number + 1
        found[name] = unique
    return found


def _turned(triangles: NDArray[np.int64], n_nodes: int) -> NDArray[np.int64]:
    """One number a triangle (n, 3), the same for its three turns, another for its mirror image; (n,)."""
    first = np.argmin(triangles, axis=1)
    turned = triangles[np.arange(len(triangles))[:, None], (first[:, None] + np.arange(3)) % 3]
    return np.asarray((turned[:, 0] * n_nodes + turned[:, 1]) * n_nodes + turned[:, 2])
