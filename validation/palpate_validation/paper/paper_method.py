"""The paper's own method: linear tetrahedra, small strain, squared distances of the surfaces' nodes, L-BFGS.

Eq. 4: Phi = 1/2 sum over organs and nodes of |d(u_l + delta u_l, u_r)|^2, d the distance between the deformed surface
and the observed one, both ways; the unknowns are the moduli in kPa (Eq. 5), from one start. What it does not have:
areas, a difference to the rest state, robust weights, a motion of the driver that is estimated (it is prescribed).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import igl
import numpy as np
from numpy.typing import NDArray
from scipy import optimize

from palpate.mechanics import LinearModel
from palpate.mesh import LagrangeSpace
from palpate.observation import ObservedSurface, observed_surface

__all__ = ["PaperFit", "PaperTarget", "paper_estimate", "paper_target"]

Array = NDArray[np.float64]

FACTOR = 100.0  # the moduli are sought within this factor of the start


@dataclass(frozen=True, slots=True)
class PaperTarget:
    """The model's `surface`, and the observed one: vertices (n, 3) mm, triangles (m, 3), seen (m,)."""

    surface: ObservedSurface
    vertices: Array
    triangles: NDArray[np.int64]
    seen: NDArray[np.bool_]


@dataclass(frozen=True, slots=True)
class PaperFit:
    """Moduli (n_parameters,) kPa where L-BFGS ended, its iterations, evaluations of Phi, and Phi (mm^2) there."""

    moduli: Array
    iterations: int
    evaluations: int
    objective_mm2: float
    converged: bool


def paper_target(space: LagrangeSpace, displacement: Array, surface: ObservedSurface) -> PaperTarget:
    """The deformed surface of a truth, u (n_points, 3) mm on its `space`, for the model's surface of that tissue."""
    truth = observed_surface(space, surface.tissue)
    return PaperTarget(surface, truth.rest + displacement[truth.points], truth.triangles, truth.observed)


def paper_estimate(
    model: LinearModel, targets: Sequence[PaperTarget], *, moduli: Array, columns: NDArray[np.int64]
) -> PaperFit:
    """Minimise Eq. 4 over the moduli of the regions `columns` (n_parameters,), from `moduli` (n_regions,) kPa.

    The others stay; the model's boundary motion is its offset alone. L-BFGS-B (Byrd et al. 1995) with SciPy's
    tolerances, in units of the start; the gradient is exact, by one adjoint solve.
    """
    start = moduli[columns]
    evaluations = 0

    def phi(relative: Array) -> tuple[float, Array]:
        """Eq. 4 of the paper (mm^2) and its gradient at moduli relative to the start's (n,)."""
        nonlocal evaluations
        evaluations += 1
        trial = moduli.copy()
        trial[columns] = relative * start
        equilibrium = model.solve(trial, np.zeros(model.n_modes))
        value, pull = 0.0, np.zeros_like(equilibrium.displacement)
        for target in targets:
            part, slope = _distances(target, equilibrium.displacement[target.surface.points])
            value += part
            np.add.at(pull, target.surface.points, slope)
        by_log = equilibrium.adjoint(pull.ravel())[columns]
        return value, by_log / relative

    ones = np.ones(len(columns))
    bounds = optimize.Bounds(ones / FACTOR, ones * FACTOR)
    found = optimize.minimize(phi, ones, jac=True, method="L-BFGS-B", bounds=bounds)
    return PaperFit(found.x * start, int(found.nit), evaluations, float(found.fun), bool(found.success))


def _distances(target: PaperTarget, motion: Array) -> tuple[float, Array]:
    """Eq. 4 of one organ, mm^2, and its derivative (n_vertices, 3) mm at a motion (n_vertices, 3) mm of its nodes.

    Closest points are held for the derivative, which is exact: where they slide, the distance is stationary.
    """
    surface = target.surface
    deformed = np.ascontiguousarray(surface.rest + motion)
    slope = np.zeros_like(deformed)
    own = np.unique(surface.triangles[surface.observed])
    faces = np.ascontiguousarray(target.triangles)
    _, _, nearest = igl.point_mesh_squared_distance(deformed[own], target.vertices, faces)[:3]
    away = deformed[own] - np.asarray(nearest)
    slope[own] += away
    seen = np.unique(target.triangles[target.seen])
    image = np.ascontiguousarray(target.vertices[seen])
    faces = np.ascontiguousarray(surface.triangles)
    _, triangle, places = igl.point_mesh_squared_distance(image, deformed, faces)[:3]
    corners = surface.triangles[np.asarray(triangle, dtype=np.int64)]
    back = np.asarray(places) - image
    weights = np.asarray(igl.barycentric_coordinates(places, *(deformed[corners[:, k]] for k in range(3))))
    np.add.at(slope, corners, weights[:, :, None] * back[:, None, :])
    return 0.5 * float(np.sum(away**2) + np.sum(back**2)), slope
