"""What a driver's wall does on a finer scale than its modes: the normal motion that its own surface still asks for."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy import linalg

from palpate.mesh.gaussian_process import kernel_factor
from palpate.mesh.surface import vertex_normals
from palpate.observation.contract import Residuals
from palpate.observation.observed_surface import ObservedSurface

__all__ = ["wall_correction"]

FINE_MODES = 400  # at the most: the kernel's rank on a wall of a hundred square centimetres


def wall_correction(
    surface: ObservedSurface,
    residuals: Residuals,
    precision: NDArray[np.float64],
    *,
    present: NDArray[np.float64],
    kernel_mm: float,
    prior_mm: float,
) -> NDArray[np.float64]:
    """Normal displacement (n_vertices, 3) mm of a wall that explains its residuals, in place of the `present` one.

    Along the unit normals n it is a Gaussian process with the covariance prior^2 exp(-|x - y|^2 / (2 kernel^2)); the
    result is its posterior mean under r = r_0 + J w + noise, with the residuals r at the `present` (n_vertices, 3) mm,
    J their `smooth_jacobian` and `precision` (n,) mm^-2 that of each residual (Rasmussen & Williams 2006, Eq. 2.11).
    """
    scalar = prior_mm * kernel_factor(surface.rest, kernel_mm, FINE_MODES)
    normals = vertex_normals(surface.rest, surface.triangles)
    modes = (normals[:, :, None] * scalar[:, None, :]).reshape(-1, scalar.shape[1])
    design = np.asarray(residuals.smooth_jacobian @ modes)
    values = residuals.values - residuals.smooth_jacobian @ present.ravel()
    matrix = design.T @ (precision[:, None] * design) + np.eye(design.shape[1])
    coefficients = linalg.solve(matrix, -design.T @ (precision * values), assume_a="pos")
    return np.asarray((modes @ coefficients).reshape(-1, 3))
