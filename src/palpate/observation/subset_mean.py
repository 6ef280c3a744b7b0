"""What digital volume correlation measures: the motion of a box of voxels, a subset, not that of its centre."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from palpate.mesh.locate import Places, located, point_interpolation
from palpate.mesh.space import LagrangeSpace

ABSCISSAE, WEIGHTS = np.polynomial.legendre.leggauss(3)
LEAST = 1e-3  # of a full subset's own moments: with less, a part of it does not tell a slope


def subset_mean(
    space: LagrangeSpace, points: NDArray[np.float64], places: Places, edges_mm: NDArray[np.float64]
) -> sparse.csr_matrix[np.float64]:
    """Matrix (n, n_points), dimensionless: the displacement of subsets at points (n, 3) mm inside the mesh at `places`.

    A subset is a box with edges (3,) mm along x, y, z. Its warp of first order is fitted to the motion of its voxels in
    the body, each with one weight, and gives that of its centre: the mean, where the whole box lies in the body. The
    integrals are Gauss's, three places an edge. Schreier & Sutton, Exp. Mech. 42 (2002) 303.
    """
    unit = np.stack(np.meshgrid(*[ABSCISSAE] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
    share = np.einsum("i,j,k->ijk", *[WEIGHTS / 2.0] * 3).ravel()
    n, k = len(points), len(unit)
    inside = located(space.mesh, (points[:, None] + 0.5 * edges_mm * unit).reshape(-1, 3))
    here = share * inside.inside.reshape(n, k)
    terms = np.concatenate([np.ones((k, 1)), unit], axis=1)
    moments = np.einsum("nk,ki,kj->nij", here, terms, terms)
    told = np.linalg.eigvalsh(moments)[:, 0] > LEAST
    moments[~told] = np.eye(4)
    of_centre = here * (np.linalg.solve(moments, np.eye(4)[:, :1])[:, :, 0] @ terms.T)
    whole, sampled = np.where(told, 0.0, 1.0), np.where(told[:, None], of_centre, 0.0)[here > 0.0]
    rows = np.nonzero(here > 0.0)[0]
    averages = sparse.csr_matrix((sampled, (rows, np.arange(len(rows)))), shape=(n, len(rows)))
    samples = point_interpolation(space, inside.of(inside.inside))
    return sparse.csr_matrix(averages @ samples + sparse.diags_array(whole) @ point_interpolation(space, places))
