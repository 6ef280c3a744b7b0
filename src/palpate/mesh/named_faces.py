"""Which faces of a mesh's boundary a plane or a group of triangles names, and what lies behind them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from palpate.errors import GeometryError
from palpate.images.tissue import Role, Tissue

WHOLE = "boundary"
PLANES = tuple(f"{axis}_{end}" for axis in "xyz" for end in ("min", "max"))
LEANS_DEG = 15.0  # of a surface against the plane that it is named by


def plane_faces(
    nodes: NDArray[np.float64], faces: NDArray[np.int64], plane: str, within_mm: float
) -> NDArray[np.bool_]:
    """Which faces (n_faces, 3) lie within so many mm of a plane of `PLANES`, or on the `WHOLE` boundary.

    Raises `GeometryError` where they lean against it, as the part of a bent tip does that reaches furthest.
    """
    if plane == WHOLE:
        return np.ones(len(faces), dtype=bool)
    axis, end = "xyz".index(plane[0]), plane[2:]
    along = nodes[:, axis] if end == "max" else -nodes[:, axis]
    found = np.asarray(along[faces].min(axis=1) >= along.max() - within_mm)
    a, b, c = np.moveaxis(nodes[faces[found]], 1, 0)
    area = np.abs(np.cross(b - a, c - a).sum(axis=0))
    lean = float(np.degrees(np.arccos(min(area[axis] / max(float(np.linalg.norm(area)), 1e-300), 1.0))))
    if found.any() and lean > LEANS_DEG:
        raise GeometryError(
            f"the faces within {within_mm:g} mm of {plane} lean against that plane by {lean:.0f} degrees: they are part"
            " of a surface that does not lie along it; name the surface by a group of faces of the mesh's file"
        )
    return found


def listed_faces(faces: NDArray[np.int64], triangles: NDArray[np.int64], name: str) -> NDArray[np.bool_]:
    """Which boundary faces (n_faces, 3) a group has, whose `triangles` (n, 3) differ from each other.

    Raises `GeometryError` where one is no face of the boundary: it lies between two tetrahedra, or is of none.
    """
    rows = np.sort(np.concatenate([faces, triangles]), axis=1)
    number = np.unique(rows, axis=0, return_inverse=True)[1].ravel()
    found = np.isin(number[: len(faces)], number[len(faces) :])
    if found.sum() < len(triangles):
        raise GeometryError(
            f"the group '{name}' has triangles that are no faces of the mesh's boundary, beside {found.sum()} that are:"
            " they lie inside, between two tetrahedra, or are faces of none; name a group of outer faces alone, or save"
            " the volume beside them, too (gmsh: in a physical group of its own)"
        )
    return np.asarray(found)


def tissues_behind(
    surfaces: Mapping[str, NDArray[np.bool_]], shared: Sequence[str], tissues: Sequence[Tissue], n_faces: int
) -> NDArray[np.int64]:
    """The hollow tissue (n_faces,), by its number, behind each boundary face; the last of `tissues` behind all others.

    surfaces: faces (n_faces,) by the tissue's name; the first one counts where two have a face. shared: those that have
    such faces, too. Raises `GeometryError` for a surface without a face, or one that is free in part.
    """
    behind, names = np.full(n_faces, len(tissues) - 1), [tissue.name for tissue in tissues]
    for name, faces in list(surfaces.items())[::-1]:
        if not faces.any():
            raise GeometryError(
                f"the surface '{name}' has no face of the mesh's boundary; make within_mm larger, or name another"
            )
        behind[faces] = names.index(name)
    free = np.array([tissue.role is Role.VOID for tissue in tissues])
    for name, faces in surfaces.items():
        own, held = behind[faces], not free[names.index(name)]
        if not np.any(own == names.index(name)):
            raise GeometryError(
                f"all faces of the surface '{name}' belong to surfaces that are named before it; name it first, or"
                " leave it out"
            )
        if name in shared and held and free[own].any():
            raise GeometryError(
                f"{free[own].sum()} of the {len(own)} faces of the surface '{name}' would be free, as they belong to"
                f" '{names[int(own[free[own]][0])]}', which is named before it; name '{name}' first"
            )
    return behind
