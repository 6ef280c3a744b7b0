"""How a displacement deforms its elements."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from palpate.mechanics.element import barycentric_gradients, shape_derivatives
from palpate.mesh.space import LagrangeSpace

__all__ = ["deformation_determinants"]


def deformation_determinants(space: LagrangeSpace, displacement: NDArray[np.float64]) -> NDArray[np.float64]:
    """Determinant (n_tets, 5) of F = I + grad u at corners and centres of the tetrahedra.

    displacement (n_points, 3) mm. Positive at all of them: no element is turned inside out.
    """
    places = np.vstack([np.eye(4), np.full((1, 4), 0.25)])
    gradients, _ = barycentric_gradients(space.mesh.nodes, space.mesh.tets)
    by_barycentric = np.einsum("qak,nai->nqik", shape_derivatives(space.order, places), displacement[space.cells])
    return np.asarray(np.linalg.det(np.eye(3) + by_barycentric @ gradients[:, None]))
