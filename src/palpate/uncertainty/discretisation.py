"""How far the mesh moves a log-modulus: a law of its elements' size beside the tissue's, measured on many meshes."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from palpate.mesh.space import LagrangeSpace
from palpate.mesh.surface import tissue_surface, triangle_normals

__all__ = ["discretisation_sd"]

COEFFICIENT = 0.5
LINEAR = 2.0  # edges of quadratic elements for one of linear ones: they have the same points


def discretisation_sd(space: LagrangeSpace, tissues: Sequence[int]) -> float:
    """Standard deviation of ln E, dimensionless, that another mesh of the same edge length would make.

    s = c (h / d)^2 with h = (6 sqrt(2) V / N)^(1/3), the edge of N regular tetrahedra that fill the volume V of the
    `tissues` (by their index in the mesh; several that share a modulus together), twice that for linear elements, and
    d = 6 V / A with the area A of their surfaces: the diameter of a ball, three times the thickness of a plate. The
    order is that of quadratic elements' surfaces; c is measured (`benchmarks/edge_length.py`, docs/method.md).
    """
    mesh = space.mesh
    inside = np.isin(mesh.region, tissues)
    volume = float(mesh.volumes[inside].sum())
    area = sum(
        float(np.linalg.norm(triangle_normals(mesh.nodes, tissue_surface(mesh, t).triangles), axis=1).sum())
        for t in tissues
    )
    edge = (1.0 if space.order > 1 else LINEAR) * (6.0 * np.sqrt(2.0) * volume / np.count_nonzero(inside)) ** (1 / 3)
    return float(COEFFICIENT * (edge * area / (6.0 * volume)) ** 2)
