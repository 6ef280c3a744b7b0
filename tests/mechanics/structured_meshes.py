"""Small structured meshes of known shape, for the laws of mechanics: those of the problems with known answers."""

from __future__ import annotations

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
    "quarter_ring_mesh",
    "sphere_faces",
    "unknown",
]


def every_node_prescribed(space, value):
    """Keywords for `outer_constraint`: the points on the mesh's boundary move as value(points), one offset."""
    return all_prescribed(space, value(space.points))
