"""Linear and quadratic tetrahedra: quadrature, derivatives of shape functions, and how a displacement deforms them.

Everything is written in barycentric coordinates (lambda_0, ..., lambda_3) of a straight-sided tetrahedron.
Zienkiewicz & Taylor, The Finite Element Method, vol. 1, 5th ed., section 8.8.2.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.special import roots_jacobi

from palpate.mesh.space import TET_EDGES, TRIANGLE_EDGES, LagrangeSpace

CENTRE = np.full((1, 4), 0.25)


def quadrature(degree: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Points (n_q, 4) barycentric and positive weights (n_q,), sum 1, exact for polynomials up to `degree`.

    Degree 1: the centroid; degree 2: four points (Keast 1986); above: `_conical_product`.
    """
    if degree <= 1:
        return np.full((1, 4), 0.25), np.ones(1)
    if degree == 2:
        low = (5.0 - np.sqrt(5.0)) / 20.0
        return np.full((4, 4), low) + (1.0 - 4.0 * low) * np.eye(4), np.full(4, 0.25)
    return _conical_product(degree, 3)


def triangle_quadrature(degree: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Points (n_q, 3) barycentric on a triangle and positive weights (n_q,), sum 1, exact up to `degree`."""
    return _conical_product(degree, 2)


def _conical_product(degree: int, dimension: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Of Gauss-Jacobi rules (Stroud 1971), with ceil((degree + 1) / 2) points a direction, on a simplex.

    From the cube by lambda_1 = x, lambda_2 = (1 - x) y, lambda_3 = (1 - x)(1 - y) z.
    """
    rules = [roots_jacobi(degree // 2 + 1, float(power), 0.0) for power in reversed(range(dimension))]
    cube = np.stack(np.meshgrid(*[0.5 * (1.0 + points) for points, _ in rules], indexing="ij"), axis=-1)
    weights = np.prod(np.stack(np.meshgrid(*[w / w.sum() for _, w in rules], indexing="ij"), axis=-1), axis=-1)
    left = np.cumprod(1.0 - cube, axis=-1)  # of 1, once each coordinate has had its share
    shares = cube * np.concatenate([np.ones_like(left[..., :1]), left[..., :-1]], axis=-1)
    points = np.concatenate([left[..., -1:], shares], axis=-1)
    return np.asarray(points.reshape(-1, dimension + 1)), np.asarray(weights.ravel())


def shape_derivatives(order: int, barycentric: NDArray[np.float64]) -> NDArray[np.float64]:
    """Derivatives dN_a / dlambda_k (n_q, 4 or 10, 4), dimensionless, at `barycentric` (n_q, 4) places."""
    if order == 1:
        return np.tile(np.eye(4), (len(barycentric), 1, 1))
    derivatives = np.zeros((len(barycentric), 10, 4))
    for corner in range(4):
        derivatives[:, corner, corner] = 4.0 * barycentric[:, corner] - 1.0
    for edge, (first, second) in enumerate(TET_EDGES):
        derivatives[:, 4 + edge, first] = 4.0 * barycentric[:, second]
        derivatives[:, 4 + edge, second] = 4.0 * barycentric[:, first]
    return derivatives


def reference_tensor(order: int) -> NDArray[np.float64]:
    """Mean T (n_a, n_a, 4, 4), dimensionless: T_abkl = (1 / V) int dN_a/dlambda_k dN_b/dlambda_l dV, exact."""
    points, weights = quadrature(2)
    derivatives = shape_derivatives(order, points)
    return np.asarray(np.einsum("q,qak,qbl->abkl", weights, derivatives, derivatives))


def mean_reference_tensor(order: int) -> NDArray[np.float64]:
    """Product of means (n_a, n_a, 4, 4), dimensionless: M_ak M_bl with M_ak = (1 / V) int dN_a/dlambda_k dV, exact."""
    points, weights = quadrature(order)
    mean = np.einsum("q,qak->ak", weights, shape_derivatives(order, points))
    return np.asarray(np.einsum("ak,bl->abkl", mean, mean))


def barycentric_gradients(
    nodes: NDArray[np.float64], tets: NDArray[np.int64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Gradients of lambda_k (n_tets, 4, 3) in 1/mm and signed volumes (n_tets,) in mm^3.

    nodes (n_nodes, 3) mm; tets (n_tets, 4). The rows of the inverse of [x_1 - x_0, x_2 - x_0, x_3 - x_0] are the
    gradients of lambda_1 to lambda_3; all four sum to zero.
    """
    corner = nodes[tets]
    edges = np.swapaxes(corner[:, 1:] - corner[:, :1], 1, 2)
    inverse = np.linalg.inv(edges)
    gradients = np.concatenate([-inverse.sum(axis=1, keepdims=True), inverse], axis=1)
    return gradients, np.asarray(np.linalg.det(edges) / 6.0)


def triangle_slopes(order: int, barycentric: NDArray[np.float64]) -> NDArray[np.float64]:
    """Slopes (n_q, 3 or 6, 2) of the shape functions along lambda_1 and lambda_2, lambda_0 = 1 - both, (n_q, 3)."""
    by_place = np.array([[-1.0, -1.0], [1.0, 0.0], [0.0, 1.0]])  # d lambda_k / d(lambda_1, lambda_2)
    if order == 1:
        return np.tile(by_place, (len(barycentric), 1, 1))
    corners = np.einsum("qa,ad->qad", 4.0 * barycentric - 1.0, by_place)
    first, second = TRIANGLE_EDGES.T
    edges = np.einsum("qe,ed->qed", barycentric[:, first], by_place[second])
    edges += np.einsum("qe,ed->qed", barycentric[:, second], by_place[first])
    return np.concatenate([corners, 4.0 * edges], axis=1)


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
