"""Layers of elements round organs, whose stiffness may differ from that of the tissue that they are of."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from palpate.images.tissue import Role
from palpate.mesh.space import LagrangeSpace
from palpate.mesh.surface import tissue_surface
from palpate.mesh.tet_mesh import TetMesh


@dataclass(frozen=True, slots=True)
class Layer:
    """The elements of a known tissue, by its number, that touch an organ, by its own."""

    organ: int
    tissue: int


def layers_round_organs(mesh: TetMesh) -> tuple[Layer, ...]:
    """Every `estimate` tissue with every known one that it shares a face with."""
    organs, known = (
        [number for number, tissue in enumerate(mesh.tissues) if tissue.role is role]
        for role in (Role.ESTIMATE, Role.KNOWN)
    )
    beside = {organ: set(tissue_surface(mesh, organ).other.tolist()) for organ in organs}
    return tuple(Layer(organ, tissue) for organ in organs for tissue in known if tissue in beside[organ])


def layered_space(space: LagrangeSpace, layers: Sequence[Layer]) -> LagrangeSpace:
    """The same space on a mesh that has these layers, one element thick, for tissues of their own after all others.

    Each is called as its tissue, and has its properties; an element that touches two organs is of the first layer.
    """
    if not layers:
        return space
    mesh = space.mesh
    region = mesh.region.copy()
    for number, layer in enumerate(layers, start=len(mesh.tissues)):
        region[_touching(mesh, layer) & (region == layer.tissue)] = number
    tissues = (*mesh.tissues, *(mesh.tissues[layer.tissue] for layer in layers))
    return replace(space, mesh=replace(mesh, region=region, tissues=tissues))


def layer_thickness_mm(mesh: TetMesh, layers: Sequence[Layer], organ: int) -> float:
    """Mean thickness, mm, of the layers round an organ, one element thick, in a mesh that has them not yet.

    Their volume over the area of the organ's surface that faces their tissues.
    """
    own = [layer for layer in layers if layer.organ == organ]
    surface = tissue_surface(mesh, organ)
    corner = mesh.nodes[surface.triangles[np.isin(surface.other, [layer.tissue for layer in own])]]
    areas = 0.5 * np.linalg.norm(np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]), axis=1)
    return float(sum(mesh.volumes[_touching(mesh, layer)].sum() for layer in own) / areas.sum())


def _touching(mesh: TetMesh, layer: Layer) -> NDArray[np.bool_]:
    """Which elements (n_tets,) of the layer's tissue have a corner at its organ."""
    at_organ = np.zeros(len(mesh.nodes), dtype=bool)
    at_organ[mesh.tets[mesh.region == layer.organ]] = True
    return np.asarray(at_organ[mesh.tets].any(axis=1) & (mesh.region == layer.tissue))
