"""Which faces of a mesh's boundary a plane or a group of triangles names, and what lies behind them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from palpate.errors import GeometryError
from palpate.images.tissue import Role, Tissue

WHOLE = "boundary"
PLANES = tuple(f"{axis}_{end}" for axis in "xyz" for end in ("min", "max"))
LEANS_DEG = 15.0  # largest angle between a named side's faces and its plane


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
            f"the faces within {within_mm:g} mm of {plane} lean against that plane by {lean:.0f} degrees; name the"
            " surface by a group of faces"
        )
    return found


def listed_faces(faces: NDArray[np.int64], triangles: NDArray[np.int64], name: str) -> NDArray[np.bool_]:
    """Which boundary faces (n_faces, 3) a group has, whose `triangles` (n, 3) differ from each other.

    Raises `GeometryError` where one is no face of the boundary: it lies between two tetrahedra, or is of none.
    """
    number = np.unique(np.sort(np.concatenate([faces, triangles]), axis=1), axis=0, return_inverse=True)[1].ravel()
    found = np.isin(number[: len(faces)], number[len(faces) :])
    if np.count_nonzero(found) < len(triangles):
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
    free = np.array([tissue.role is Role.VOID for tissue in tissues])
    for name, faces in list(surfaces.items())[::-1]:
        behind[faces] = names.index(name)
    for name, faces in surfaces.items():
        number, own = names.index(name), behind[faces]
        lost = own[free[own]]
        if not len(own):
            raise GeometryError(f"the surface '{name}' has no face of the boundary; make within_mm larger")
        if number not in own:
            raise GeometryError(
                f"all faces of the surface '{name}' belong to surfaces that are named before it; name it first"
            )
        if name in shared and not free[number] and len(lost):
            raise GeometryError(
                f"{len(lost)} of the {len(own)} faces of the surface '{name}' would be free, as they belong to"
                f" '{names[int(lost[0])]}', which is named before it; name '{name}' first"
            )
    return behind
