"""STL: the triangles of a closed surface, binary or text."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from palpate.errors import InputDataError
from palpate.images.input_file import read_input
from palpate.images.label_image import LPS_TO_RAS

MOST_BYTES = 2**29
MOST_TEXT = 2**26  # bytes: its numbers take some ten times as much memory while they are read
HEADING = 80  # bytes of a binary file, before the number of its triangles
FACET = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])
MOST_MM = 1e6


@dataclass(frozen=True, slots=True)
class SurfaceFile:
    """Points (n, 3) RAS mm and triangles (m, 3) of a closed surface; the SHA-256 of its file."""

    points: NDArray[np.float64]
    triangles: NDArray[np.int64]
    digest: str


def read_stl(path: Path, *, axes: str = "RAS") -> SurfaceFile:
    """Read a closed surface, mm; corners that lie in one place are one point.

    axes: "RAS" or "LPS", of a file whose heading says neither SPACE=RAS nor SPACE=LPS, as 3D Slicer's do. Raises
    `InputDataError` for what is no STL, holds what is no number, or is not closed: an edge that not exactly two
    triangles share leaves no inside.
    """
    try:
        content, digest = read_input(path, MOST_BYTES)
    except (OSError, ValueError) as error:
        raise InputDataError(f"'{path}' cannot be read: {error}; check the path") from error
    if len(content) > MOST_BYTES:
        raise InputDataError(f"'{path}' is larger than {MOST_BYTES // 2**20} MB; simplify the surface")
    count = int.from_bytes(content[HEADING : HEADING + 4], "little")
    if len(content) == HEADING + 4 + count * FACET.itemsize:
        corners = np.asarray(np.frombuffer(content, FACET, count, HEADING + 4)["corners"], dtype=np.float64)
    elif content.lstrip()[:5].lower() != b"solid":
        raise InputDataError(
            f"'{path}' is no STL: neither a text that begins with 'solid', nor whole triangles; export it"
        )
    elif len(content) > MOST_TEXT:
        raise InputDataError(f"'{path}' is a text of over {MOST_TEXT // 2**20} MB; export it as a binary STL")
    else:
        found = re.findall(rb"vertex\s+(\S+)\s+(\S+)\s+(\S+)", content)
        try:
            corners = np.array(found, dtype=np.float64).reshape(-1, 3, 3)
        except ValueError as error:
            raise InputDataError(f"'{path}' is a damaged text ({error}); export it again") from error
    if not np.isfinite(corners).all() or np.abs(corners).max(initial=0.0) > MOST_MM:
        raise InputDataError(f"'{path}' has coordinates that are no number of millimetres; export it again")
    stated = re.search(rb"SPACE=(RAS|LPS)", content[:HEADING])
    signs = LPS_TO_RAS if (stated[1].decode() if stated else axes) == "LPS" else np.ones(3)
    points, numbers = np.unique(corners.reshape(-1, 3), axis=0, return_inverse=True)
    triangles = numbers.reshape(-1, 3)
    triangles = triangles[(triangles != np.roll(triangles, 1, axis=1)).all(axis=1)]  # of two corners in one place
    edges = np.sort(triangles[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
    open_ = int(np.count_nonzero(np.unique(edges, axis=0, return_counts=True)[1] % 2))
    if not len(triangles) or open_:
        raise InputDataError(
            f"'{path}' is not closed ({len(triangles)} triangles, {open_} edges of an odd number of them), so that it"
            " has no inside; fill its holes where it was made"
        )
    return SurfaceFile(points * signs, triangles, digest)
