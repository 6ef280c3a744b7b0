"""Small structured meshes of known shape, for the laws of mechanics: those of the problems with known answers."""

from __future__ import annotations

import numpy as np

from palpate.mechanics.boundary import outer_constraint
from palpate.mesh.space import lagrange_space
from palpate_validation.conditions import (
    all_prescribed,
    held_components,
    mean_radial,
    prescribe,
    pressure_load,
    sphere_faces,
)
from palpate_validation.structured_meshes import (
    VOID,
    box_mesh,
    known,
    kuhn_tets,
    make_mesh,
    octant_mesh,
    oriented,
    quarter_ring_mesh,
    unknown,
)

__all__ = [
    "VOID",
    "box_mesh",
    "every_node_prescribed",
    "held_components",
    "known",
    "kuhn_tets",
    "make_mesh",
    "mean_radial",
    "octant_mesh",
    "oriented",
    "prescribe",
    "pressure_load",
    "pushed_block",
    "quarter_ring_mesh",
    "sphere_faces",
    "unknown",
]


def every_node_prescribed(space, value):
    """Keywords for `outer_constraint`: the points on the mesh's boundary move as value(points), one offset."""
    return all_prescribed(space, value(space.points))


def pushed_block(*, outer="fixed", n=3):
    """Space and constraint of a block of 30 mm whose floor is pushed up (mode 0) and aside (mode 1) by 1 mm."""
    mesh = box_mesh(
        n,
        size=30.0,
        distortion=0.15,
        tissues=[known("fat", nu=0.45), unknown("organ", nu=0.4)],
        region=lambda c: (c[:, 2] > 15.0).astype(int),
    )
    space = lagrange_space(mesh, "P2")
    floor = np.flatnonzero(space.points[:, 2] < 1e-9)
    bump = np.prod(np.sin(np.pi * space.points[floor, :2] / 30.0), axis=1)
    modes = np.zeros((len(floor), 3, 2))
    modes[:, 2, 0], modes[:, 0, 1] = bump, bump
    return space, outer_constraint(space, outer=outer, **prescribe(space, floor, 0.0 * modes[:, :, 0], modes))
