"""Layers of elements round organs, whose stiffness may differ from that of the tissue that they are of."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from palpate.images.tissue import Role
from palpate.mesh.space import LagrangeSpace
from palpate.mesh.surface import tissue_surface
from palpate.mesh.tet_mesh import TetMesh

__all__ = ["Layer", "layer_thickness_mm", "layered_space", "layers_round_organs"]


@dataclass(frozen=True, slots=True)
class Layer:
    """The elements of a known tissue, by its number, that touch an organ, by its own."""

    organ: int
    tissue: int


def layers_round_organs(mesh: TetMesh) -> tuple[Layer, ...]:
    """Every known tissue beside every `estimate` one that share a point."""
    numbers = {role: [n for n, t in enumerate(mesh.tissues) if t.role is role] for role in (Role.ESTIMATE, Role.KNOWN)}
    points = {number: np.unique(mesh.tets[mesh.region == number]) for of in numbers.values() for number in of}
    pairs = [Layer(organ, tissue) for organ in numbers[Role.ESTIMATE] for tissue in numbers[Role.KNOWN]]
    return tuple(pair for pair in pairs if np.intersect1d(points[pair.organ], points[pair.tissue]).size)


def layered_space(space: LagrangeSpace, layers: Sequence[Layer]) -> LagrangeSpace:
    """The same space on a mesh that has these layers, one element thick, for tissues of their own after all others.

    Each is called as its tissue, and has its properties; an element that touches two organs is of the first layer.
    """
    if not layers:
        return space
    mesh = space.mesh
    region = mesh.region.copy()
    for number, layer in enumerate(layers, start=len(mesh.tissues)):
        at_organ = np.zeros(len(mesh.nodes), dtype=bool)
        at_organ[mesh.tets[mesh.region == layer.organ]] = True
        region[at_organ[mesh.tets].any(axis=1) & (region == layer.tissue)] = number
    tissues = (*mesh.tissues, *(mesh.tissues[layer.tissue] for layer in layers))
    return replace(space, mesh=replace(mesh, region=region, tissues=tissues))


def layer_thickness_mm(mesh: TetMesh, layers: Sequence[Layer], organ: int) -> float:
    """Mean thickness, mm, of the layers round an organ in a mesh that has them last: their volume over its surface."""
    first = len(mesh.tissues) - len(layers)
    own = [number for number, layer in enumerate(layers, start=first) if layer.organ == organ]
    surface = tissue_surface(mesh, organ)
    corner = mesh.nodes[surface.triangles[np.isin(surface.other, own)]]
    areas = 0.5 * np.linalg.norm(np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]), axis=1)
    return float(mesh.volumes[np.isin(mesh.region, own)].sum() / areas.sum())
