"""Size and quality of a body's mesh, for its result."""

from __future__ import annotations

from palpate.study.body import Body
from palpate.study.result import MeshSummary

__all__ = ["mesh_summary"]


def mesh_summary(body: Body) -> MeshSummary:
    """Figures of the mesh of `body`."""
    quality = body.quality
    return MeshSummary(
        quality.nodes,
        quality.tets,
        3 * len(body.space.points),
        quality.min_dihedral_deg,
        quality.p5_dihedral_deg,
        quality.volume_error,
        body.edge_length.mm if body.edge_length else None,
        body.edge_length.in_words if body.edge_length else "",
    )
