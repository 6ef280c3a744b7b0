"""How a displacement deforms its elements."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from palpate.mechanics.element import barycentric_gradients, quadrature, shape_derivatives
from palpate.mesh.space import LagrangeSpace

CENTRE = np.full((1, 4), 0.25)


def deformation_determinants(space: LagrangeSpace, displacement: NDArray[np.float64]) -> NDArray[np.float64]:
    """Determinant (n_tets, 5) of F = I + grad u at corners and centres of the tetrahedra.

    displacement (n_points, 3) mm. Positive at all of them: no element is turned inside out.
    """
    return np.asarray(np.linalg.det(_gradients(space, displacement, np.vstack([np.eye(4), CENTRE]))))


def largest_strains(space: LagrangeSpace, displacement: NDArray[np.float64]) -> NDArray[np.float64]:
    """Largest absolute principal Green-Lagrange strain (n_tets,), dimensionless, at the tetrahedra's centres.

    displacement (n_points, 3) mm. E = (F^T F - I) / 2 with F = I + grad u: no rotation counts as strain (Bonet & Wood,
    Nonlinear Continuum Mechanics, 2nd ed. 2008, section 4.5). NaN where a displacement is not finite.
    """
    deformation = _gradients(space, displacement, CENTRE)[:, 0]
    strains = 0.5 * (np.swapaxes(deformation, 1, 2) @ deformation - np.eye(3))
    finite = np.isfinite(strains.sum(axis=(1, 2)))
    principal = np.linalg.eigvalsh(np.where(finite[:, None, None], strains, 0.0))
    return np.where(finite, np.abs(principal).max(axis=1), np.nan)


def volumes_after(space: LagrangeSpace, displacement: NDArray[np.float64]) -> NDArray[np.float64]:
    """Volumes (n_tets,) mm^3 of the tetrahedra moved by (n_points, 3) mm: the integral of det F, exact."""
    points, weights = quadrature(3 * (space.order - 1))
    return np.asarray(space.mesh.volumes * (np.linalg.det(_gradients(space, displacement, points)) @ weights))


def _gradients(
    space: LagrangeSpace, displacement: NDArray[np.float64], places: NDArray[np.float64]
) -> NDArray[np.float64]:
    """F = I + grad u (n_tets, n_places, 3, 3), dimensionless, at barycentric places (n_places, 4)."""
    gradients, _ = barycentric_gradients(space.mesh.nodes, space.mesh.tets)
    by_barycentric = np.einsum("qak,nai->nqik", shape_derivatives(space.order, places), displacement[space.cells])
    return np.asarray(np.eye(3) + by_barycentric @ gradients[:, None])
