"""STL: the triangles of a closed surface, binary or text."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from palpate.errors import InputDataError
from palpate.images.input_file import whole_input

MOST_BYTES = 2**29
MOST_TEXT = 2**26  # bytes: its numbers take some ten times as much memory while they are read
HEADING = 80  # bytes of a binary file, before the number of its triangles
FACET = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])
MOST_MM = 1e6


@dataclass(frozen=True, slots=True)
class SurfaceFile:
    """Points (n, 3) mm and triangles (m, 3) of a closed surface; the SHA-256 of its file.

    space: "RAS" or "LPS", as its heading says; empty where it does not.
    """

    points: NDArray[np.float64]
    triangles: NDArray[np.int64]
    digest: str
    space: str

    @property
    def ends(self) -> NDArray[np.float64]:
        """Its lowest and highest coordinates (2, 3) mm."""
        return np.array([self.points.min(axis=0), self.points.max(axis=0)])

    @property
    def held_mm3(self) -> float:
        """Volume that the triangles enclose, mm^3."""
        a, b, c = np.moveaxis(self.points[self.triangles] - self.points[0], 1, 0)
        return float(abs(np.einsum("ni,ni->n", a, np.cross(b, c)).sum()) / 6.0)


def read_stl(path: Path) -> SurfaceFile:
    """Read a closed surface, mm; corners that lie in one place are one point.

    Raises `InputDataError` for what is no STL, holds what is no number, is not closed (an edge of an odd number of
    triangles leaves no inside), or has triangles that face opposite ways.
    """
    content, digest = whole_input(path, MOST_BYTES)
    count = int.from_bytes(content[HEADING : HEADING + 4], "little")
    whole = HEADING + 4 + count * FACET.itemsize  # those bytes of a text are a huge number
    if len(content) == whole or (count and len(content) > whole):
        corners = np.asarray(np.frombuffer(content, FACET, count, HEADING + 4)["corners"], dtype=np.float64)
    elif content.lstrip()[:5].lower() != b"solid":
        raise InputDataError(
            f"'{path}' is not an STL file: it is neither binary with whole triangles nor a text that begins with"
            " 'solid'"
        )
    elif len(content) > MOST_TEXT:
        raise InputDataError(f"'{path}' is a text of over {MOST_TEXT // 2**20} MB; export it as a binary STL")
    else:
        found = re.findall(rb"(?i:vertex)\s+(\S+)\s+(\S+)\s+(\S+)", content)
        try:
            corners = np.array(found, dtype=np.float64).reshape(-1, 3, 3)
        except ValueError as error:
            raise InputDataError(f"'{path}' is a damaged text ({error}); export it again") from error
    if not np.isfinite(corners).all() or np.abs(corners).max(initial=0.0) > MOST_MM:
        raise InputDataError(
            f"'{path}' has coordinates that are not finite, or too large for millimetres; export it again"
        )
    points, numbers = np.unique(corners.reshape(-1, 3), axis=0, return_inverse=True)
    triangles = numbers.reshape(-1, 3)
    triangles = triangles[(triangles != np.roll(triangles, 1, axis=1)).all(axis=1)]  # of two corners in one place
    edges = triangles[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2)
    edge, shared = np.unique(np.sort(edges, axis=1), axis=0, return_inverse=True, return_counts=True)[1:]
    turns = np.bincount(edge.reshape(-1), weights=np.sign(edges[:, 1] - edges[:, 0]), minlength=len(shared))
    open_, opposed = np.count_nonzero(shared % 2), np.count_nonzero(turns[shared % 2 == 0])
    if not len(triangles) or open_:
        flaw = f"{open_} edges of its {len(triangles)} triangles lack a neighbour"
        raise InputDataError(f"'{path}' is not closed ({flaw}); fill its holes in the program that made it")
    if opposed:
        advice = "recalculate its normals (Blender: Recalculate Outside; MeshLab: Re-Orient all faces coherently)"
        flaw = f"the triangles beside {opposed} of {len(shared)} edges of '{path}' face opposite ways"
        raise InputDataError(f"{flaw}; {advice}")
    stated = re.search(rb"SPACE=(RAS|LPS)", content[:HEADING])
    return SurfaceFile(points, triangles, digest, stated[1].decode() if stated else "")
