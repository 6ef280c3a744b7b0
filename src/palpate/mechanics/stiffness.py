"""Stiffness matrix of one tissue, isotropic small-strain elasticity."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from palpate.errors import ConfigurationError, GeometryError
from palpate.mechanics.dilatation import Dilatation, pointwise_lame, pointwise_lame_slope
from palpate.mechanics.element import barycentric_gradients, mean_reference_tensor, reference_tensor
from palpate.mechanics.pattern import block_pattern
from palpate.mesh.space import LagrangeSpace

CHUNK = 4096  # elements at once: some 30 MB of P2 blocks


def lame_parameters(youngs_modulus: float, poisson_ratio: float) -> tuple[float, float]:
    """Lame's (lambda, mu) in the unit of `youngs_modulus` (kPa): E nu / ((1 + nu)(1 - 2 nu)) and E / (2 (1 + nu)).

    Raises `ConfigurationError` unless -1 < nu < 0.5.
    """
    if not -1.0 < poisson_ratio < 0.5:
        raise ConfigurationError(f"Poisson's ratio is {poisson_ratio}; an isotropic elastic solid needs -1 < nu < 0.5")
    mu = youngs_modulus / (2.0 * (1.0 + poisson_ratio))
    return 2.0 * mu * poisson_ratio / (1.0 - 2.0 * poisson_ratio), mu


def lame_by_poisson(youngs_modulus: float, poisson_ratio: float) -> tuple[float, float]:
    """Derivatives of Lame's (lambda, mu) with respect to nu, in the unit of `youngs_modulus` (kPa).

    E (1 + 2 nu^2) / ((1 + nu)(1 - 2 nu))^2 and -E / (2 (1 + nu)^2).
    """
    nu = poisson_ratio
    by_lame = youngs_modulus * (1.0 + 2.0 * nu**2) / ((1.0 + nu) * (1.0 - 2.0 * nu)) ** 2
    return by_lame, -youngs_modulus / (2.0 * (1.0 + nu) ** 2)


def lame_parts(poisson_ratio: float, dilatation: Dilatation) -> tuple[float, float, float]:
    """Mu, lambda at the points, lambda in the mean over Young's modulus, dimensionless; raises `ConfigurationError`."""
    lame, mu = lame_parameters(1.0, poisson_ratio)
    pointwise = pointwise_lame(dilatation, lame, mu)
    return mu, pointwise, lame - pointwise


def lame_parts_by_poisson(poisson_ratio: float, dilatation: Dilatation) -> tuple[float, float, float]:
    """Derivatives of `lame_parts` with respect to nu, dimensionless."""
    lame, mu = lame_parameters(1.0, poisson_ratio)
    by_lame, by_mu = lame_by_poisson(1.0, poisson_ratio)
    pointwise = pointwise_lame_slope(dilatation, lame, mu, by=(by_lame, by_mu))
    return by_mu, pointwise, by_lame - pointwise


def tissue_stiffness(
    space: LagrangeSpace, tissue: int, poisson_ratio: float, *, dilatation: Dilatation = Dilatation.POINTWISE
) -> sparse.csr_matrix[np.float64]:
    """Stiffness (n_dof, n_dof), mN/mm, of the tissue's tetrahedra at a Young's modulus of 1 kPa.

    tissue: index in `space.mesh.tissues`; the unknown of point p along axis i has the number 3 p + i. With
    H_ab = int grad N_a (x) grad N_b dV the block of points a and b is lambda H_ab + mu H_ab^T + mu tr(H_ab) I
    (Hughes, The Finite Element Method, 1987, section 2.8); the part of lambda that `dilatation` takes in the mean has
    the means of grad N_a and grad N_b instead. Raises `GeometryError` where a tetrahedron has no
    positive volume, `ConfigurationError` for an impossible Poisson's ratio.
    """
    return _stiffness(space, tissue, lame_parts(poisson_ratio, dilatation))


def _stiffness(space: LagrangeSpace, tissue: int, weights: tuple[float, float, float]) -> sparse.csr_matrix[np.float64]:
    mu, pointwise, in_mean = weights
    inside = space.mesh.region == tissue
    cells = space.cells[inside]
    gradients, volumes = checked_gradients(space, inside)
    tensor = reference_tensor(space.order).reshape(-1, 16)
    mean = mean_reference_tensor(space.order).reshape(-1, 16)
    blocks = np.empty((len(cells), len(tensor), 9))
    for start in range(0, len(cells), CHUNK):
        part = slice(start, start + CHUNK)
        np.matmul(tensor, _constant_gradient_blocks(gradients[part], volumes[part], (pointwise, mu)), out=blocks[part])
        if in_mean:
            blocks[part] += mean @ _constant_gradient_blocks(gradients[part], volumes[part], (in_mean, 0.0))
    return block_pattern(cells, len(space.points)).assemble(blocks.reshape(-1, 9)).tocsr()


def stiffness_by_poisson(
    space: LagrangeSpace, tissue: int, poisson_ratio: float, *, dilatation: Dilatation = Dilatation.POINTWISE
) -> sparse.csr_matrix[np.float64]:
    """Derivative (n_dof, n_dof), mN/mm, of `tissue_stiffness` with respect to nu; raises as that does."""
    return _stiffness(space, tissue, lame_parts_by_poisson(poisson_ratio, dilatation))


def checked_gradients(
    space: LagrangeSpace, inside: NDArray[np.bool_]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Gradients (n, 4, 3) 1/mm and volumes (n,) mm^3 of the tetrahedra marked in `inside` (n_tets,).

    Raises `GeometryError` unless all volumes are positive.
    """
    mesh = space.mesh
    flat = inside & ~(mesh.volumes > 0.0)
    if flat.any():
        worst = int(np.flatnonzero(flat)[0])
        raise GeometryError(
            f"{int(flat.sum())} tetrahedra have no positive volume, the first is number {worst}"
            f" ({mesh.volumes[worst]:.3g} mm^3): repair the mesh, or make a new one with another edge length"
        )
    return barycentric_gradients(mesh.nodes, mesh.tets[inside])


def _constant_gradient_blocks(
    gradients: NDArray[np.float64], volumes: NDArray[np.float64], lame: tuple[float, float]
) -> NDArray[np.float64]:
    """Blocks (n, 16, 9) mN/mm of the pairs (lambda_k, lambda_l), before weighting with the reference tensor."""
    first, second = lame
    dyads = np.einsum("e,eki,elj->eklij", volumes, gradients, gradients)
    blocks = first * dyads + second * np.swapaxes(dyads, 3, 4)
    trace = second * np.einsum("eklii->ekl", dyads)
    for axis in range(3):
        blocks[..., axis, axis] += trace
    return np.asarray(blocks.reshape(-1, 16, 9))
