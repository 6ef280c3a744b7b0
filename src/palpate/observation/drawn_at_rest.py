"""How a surface may lie otherwise than the reference image draws it: an error that all later images share.

The more later images there are, the more it counts: it does not average out, and patchy tissues, which all later images
share too, would else explain it.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from palpate.mesh.gaussian_process import karhunen_loeve, kernel_factor
from palpate.mesh.surface import triangle_normals, vertex_normals
from palpate.observation.observed_surface import ObservedSurface

LENGTHS_MM = (8.0, 20.0)  # over which errors of a drawing are alike; on the mesh nothing finer is seen
SHARE, MODES = 0.9, 60  # of the variance, and number, of the modes of a surface
UNIT_MM = 0.5  # standard deviation where an amplitude is 1


def modes_at_rest(surface: ObservedSurface) -> tuple[NDArray[np.float64], tuple[NDArray[np.float64], ...]]:
    """Modes (n_dofs, m) mm along the normals of a surface, and covariances (m, m) of their coefficients by length.

    They are those of Gaussian processes over the surface, with the standard deviation `UNIT_MM`.
    """
    points, triangles = surface.rest, surface.triangles
    areas = 0.5 * np.linalg.norm(triangle_normals(points, triangles), axis=1)
    weights = np.bincount(triangles.ravel(), np.repeat(areas / 3.0, 3), len(points)).astype(np.float64)
    scalar = karhunen_loeve(points, weights, kernel_mm=LENGTHS_MM[0], share=SHARE, most=MODES)
    inverse, rank = np.linalg.pinv(scalar), min(len(points), 3 * scalar.shape[1])
    amounts = [inverse @ kernel_factor(points, length, rank) for length in LENGTHS_MM]
    along = UNIT_MM * scalar[:, None] * vertex_normals(points, triangles)[:, :, None]
    return along.reshape(3 * len(points), -1), tuple(np.asarray(a @ a.T) for a in amounts)
