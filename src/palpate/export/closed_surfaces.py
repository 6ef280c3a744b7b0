"""The surface of each tissue before and after as closed triangles, normals outwards: OBJ, PLY and STL.

A file a tissue and state. Their headings tell 3D Slicer that the coordinates are RAS.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from palpate.export.case_files import file_name
from palpate.export.fitted_model import FittedBody, FittedModel
from palpate.export.groups import rows
from palpate.images.tissue import Role
from palpate.mesh.surface import tissue_surface, triangle_normals
from palpate.observation.observed_surface import SUBTRIANGLES
from palpate.study.outputs import write_bytes

HEADING = b"SPACE=RAS; lengths in mm"
FACE = np.dtype([("count", "u1"), ("corners", "<i4", 3)])  # of PLY
FACET = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])  # of STL


@dataclass(frozen=True, slots=True)
class ClosedSurface:
    """Points (n, 3) RAS mm and triangles (m, 3) of a tissue in one state; the same triangles in all states.

    stem: a name for its file; state: "before" or "after", numbered where there are several later images.
    """

    stem: str
    name: str
    state: str
    points: NDArray[np.float64]
    triangles: NDArray[np.int64]


def closed_surfaces(body: FittedBody) -> Iterator[ClosedSurface]:
    """Each tissue's surface before and after each later image, but for `void`; a quadratic face is four triangles.

    Where a hollow tissue leaves the image its wall is closed by a fan of triangles about the middle of its rim.
    """
    space = body.space
    several = len(body.displacements) > 1
    states = {"before": space.points}
    for number, displacement in enumerate(body.displacements, start=1):
        states[f"after_{number}" if several else "after"] = space.points + displacement
    for number, tissue in enumerate(body.tissues):
        faces = tissue_surface(body.mesh, number).triangles
        if not len(faces) or tissue.role is Role.VOID:  # the air around a body is no body
            continue
        facets = space.facets(faces)
        flat = facets[:, SUBTRIANGLES] if space.order == 2 else facets
        used, local = np.unique(flat, return_inverse=True)
        triangles = local.reshape(-1, 3)
        rims = _rims(triangles)
        fans = [  # about the points that follow those of the mesh
            np.stack([np.roll(rim, -1), rim, np.full(len(rim), len(used) + place)], axis=1)
            for place, rim in enumerate(rims)
        ]
        closed = np.concatenate([triangles, *fans])
        for state, points in states.items():
            caps = [points[used][rim].mean(axis=0) for rim in rims]
            stem = f"{number:02d}_{file_name(tissue.name)}_{state}"
            own = np.concatenate([points[used], np.reshape(caps, (-1, 3))])
            yield ClosedSurface(stem, tissue.name, state, own, closed)


def write_obj(model: FittedModel, body: FittedBody, folder: Path) -> None:
    """Write Wavefront's text: points, then triangles that count them from 1; the tissue's name is its object's."""
    del model
    for surface in closed_surfaces(body):
        heading = f"# {HEADING.decode()}\no {surface.name}\n"
        text = heading + rows("v %.9g %.9g %.9g", surface.points) + rows("f %d %d %d", surface.triangles + 1)
        write_bytes(folder / f"{surface.stem}.obj", text.encode())


def write_ply(model: FittedModel, body: FittedBody, folder: Path) -> None:
    """Write binary little-endian, double precision: a heading that describes the rows of numbers after it."""
    del model
    for surface in closed_surfaces(body):
        heading = (
            f"ply\nformat binary_little_endian 1.0\ncomment {HEADING.decode()}\n"
            f"element vertex {len(surface.points)}\nproperty double x\nproperty double y\nproperty double z\n"
            f"element face {len(surface.triangles)}\nproperty list uchar int vertex_indices\nend_header\n"
        )
        faces = np.zeros(len(surface.triangles), dtype=FACE)
        faces["count"], faces["corners"] = 3, surface.triangles
        content = heading.encode() + surface.points.astype("<f8").tobytes() + faces.tobytes()
        write_bytes(folder / f"{surface.stem}.ply", content)


def write_stl(model: FittedModel, body: FittedBody, folder: Path) -> None:
    """Write binary: 80 bytes of heading, the number of facets, and each with its normal."""
    del model
    for surface in closed_surfaces(body):
        facets = np.zeros(len(surface.triangles), dtype=FACET)
        normals = triangle_normals(surface.points, surface.triangles)
        lengths = np.linalg.norm(normals, axis=1, keepdims=True)
        facets["normal"] = normals / np.maximum(lengths, np.finfo(float).tiny)
        facets["corners"] = surface.points[surface.triangles]
        content = HEADING.ljust(80) + np.uint32(len(facets)).tobytes() + facets.tobytes()
        write_bytes(folder / f"{surface.stem}.stl", content)


def _rims(triangles: NDArray[np.int64]) -> list[NDArray[np.int64]]:
    """Points of each closed line of edges that only one triangle has, in the triangles' own direction."""
    edges = triangles[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2)
    both = {(a, b) for a, b in edges.tolist()}
    following: dict[int, list[int]] = {}
    for a, b in edges.tolist():
        if (b, a) not in both:
            following.setdefault(a, []).append(b)
    rims = []
    while following:
        first = next(iter(following))
        rim, point = list[int](), first
        while not rim or point != first:
            rim.append(point)
            point_after = following[point].pop()
            if not following[point]:
                del following[point]
            point = point_after
        rims.append(np.array(rim))
    return rims
