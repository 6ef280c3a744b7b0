"""What the images prescribe: the driver wall's modes, and the measured motion of the bones."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from palpate.images.alignment import RigidMotion
from palpate.images.tissue import Role
from palpate.mesh.space import LagrangeSpace
from palpate.mesh.surface import tissue_surface, triangle_normals
from palpate.observation.wall_modes import Wall, wall_modes, wall_of

__all__ = ["PrescribedMotion", "prescribed_motion"]


@dataclass(frozen=True, slots=True)
class PrescribedMotion:
    """Displacement `modes q + offset` of the marked points.

    modes (3 n_points, n_modes) mm, offset (3 n_points,) mm, prescribed (n_points,); `walls`: what the modes move.
    """

    modes: NDArray[np.float64]
    offset: NDArray[np.float64]
    prescribed: NDArray[np.bool_]
    walls: tuple[Wall, ...] = ()


def prescribed_motion(
    space: LagrangeSpace, bones: Mapping[int, RigidMotion], *, n_modes: int, kernel_mm: float, prior_mm: float
) -> PrescribedMotion:
    """Modes of every driver's wall and the offset of every rigid tissue (by index in `bones`; held where absent).

    A point that a driver and a bone share follows the bone. Each driver has its own `n_modes` modes (see
    `wall_modes` for kernel_mm and prior_mm, mm).
    """
    n = len(space.points)
    offset, prescribed = np.zeros((n, 3)), np.zeros(n, dtype=bool)
    blocks, walls = list[NDArray[np.float64]](), list[Wall]()
    roles = [tissue.role for tissue in space.mesh.tissues]
    for tissue in (i for i, role in enumerate(roles) if role is Role.RIGID):
        points = np.unique(space.facets(tissue_surface(space.mesh, tissue).triangles))
        prescribed[points] = True
        if tissue in bones:
            offset[points] = bones[tissue].apply(space.points[points]) - space.points[points]
    held = prescribed.copy()
    for tissue in (i for i, role in enumerate(roles) if role is Role.DRIVER):
        triangles = tissue_surface(space.mesh, tissue).triangles
        facets = space.facets(triangles)
        sums = np.zeros((n, 3))
        np.add.at(sums, facets, triangle_normals(space.mesh.nodes, triangles)[:, None])
        points = np.unique(facets)
        points = points[~held[points]]
        normals = sums[points] / np.maximum(np.linalg.norm(sums[points], axis=1, keepdims=True), np.finfo(float).tiny)
        local = wall_modes(space.points[points], n_modes=n_modes, kernel_mm=kernel_mm, prior_mm=prior_mm)
        block = np.zeros((n, 3, local.shape[1]))
        block[points] = local.reshape(len(points), 3, -1)
        first = sum(b.shape[1] for b in blocks)
        blocks.append(block.reshape(3 * n, -1))
        columns = np.arange(first, first + local.shape[1])
        if len(columns):
            own = {"kernel_mm": kernel_mm, "prior_mm": prior_mm}
            name = space.mesh.tissues[tissue].name
            walls.append(wall_of(space.points[points], normals, local, columns, name=name, **own))
        prescribed[points] = True
    modes = np.concatenate(blocks, axis=1) if blocks else np.zeros((3 * n, 0))
    return PrescribedMotion(modes, offset.ravel(), prescribed, tuple(walls))
