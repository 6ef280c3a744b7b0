"""Stiffness matrix of one tissue, isotropic small-strain elasticity."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from palpate.errors import ConfigurationError, GeometryError
from palpate.mechanics.element import barycentric_gradients, reference_tensor
from palpate.mesh.space import LagrangeSpace

__all__ = ["lame_parameters", "tissue_stiffness"]

CHUNK = 4096  # elements at once: some 30 MB of P2 blocks


def lame_parameters(youngs_modulus: float, poisson_ratio: float) -> tuple[float, float]:
    """Lame's (lambda, mu) in the unit of `youngs_modulus` (kPa): E nu / ((1 + nu)(1 - 2 nu)) and E / (2 (1 + nu)).

    Raises `ConfigurationError` unless -1 < nu < 0.5.
    """
    if not -1.0 < poisson_ratio < 0.5:
        raise ConfigurationError(f"Poisson's ratio is {poisson_ratio}; an isotropic elastic solid needs -1 < nu < 0.5")
    mu = youngs_modulus / (2.0 * (1.0 + poisson_ratio))
    return 2.0 * mu * poisson_ratio / (1.0 - 2.0 * poisson_ratio), mu


def tissue_stiffness(space: LagrangeSpace, tissue: int, poisson_ratio: float) -> sparse.csr_matrix[np.float64]:
    """Stiffness (n_dof, n_dof), mN/mm, of the tissue's tetrahedra at a Young's modulus of 1 kPa.

    tissue: index in `space.mesh.tissues`; the unknown of point p along axis i has the number 3 p + i. With
    H_ab = int grad N_a (x) grad N_b dV the block of points a and b is lambda H_ab + mu H_ab^T + mu tr(H_ab) I
    (Hughes, The Finite Element Method, 1987, section 2.8). Raises `GeometryError` where a tetrahedron has no
    positive volume, `ConfigurationError` for an impossible Poisson's ratio.
    """
    inside = space.mesh.region == tissue
    cells = space.cells[inside]
    gradients, volumes = _checked_gradients(space, inside)
    lame = lame_parameters(1.0, poisson_ratio)
    tensor = reference_tensor(space.order).reshape(-1, 16)
    blocks = np.empty((len(cells), len(tensor), 9))
    for start in range(0, len(cells), CHUNK):
        part = slice(start, start + CHUNK)
        np.matmul(tensor, _constant_gradient_blocks(gradients[part], volumes[part], lame), out=blocks[part])
    return _sum_blocks(cells, blocks.reshape(-1, 9), len(space.points))


def _checked_gradients(
    space: LagrangeSpace, inside: NDArray[np.bool_]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Gradients (n, 4, 3) 1/mm and volumes (n,) mm^3 of the marked tetrahedra; `GeometryError` unless all positive."""
    mesh = space.mesh
    flat = inside & ~(mesh.volumes > 0.0)
    if flat.any():
        worst = int(np.flatnonzero(flat)[0])
        raise GeometryError(
            f"{int(flat.sum())} tetrahedra have no positive volume, the first is number {worst}"
            f" ({mesh.volumes[worst]:.3g} mm^3): repair the mesh or make it anew with another edge length"
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


def _sum_blocks(cells: NDArray[np.int64], blocks: NDArray[np.float64], n_points: int) -> sparse.csr_matrix[np.float64]:
    """Sum the 3 x 3 blocks (n_cells * n_a * n_a, 9) of all cells into one matrix; each block's place is sorted once."""
    keys = (cells[:, :, None] * n_points + cells[:, None, :]).ravel()
    order = np.argsort(keys, kind="stable")
    ordered = keys[order]
    first = np.flatnonzero(np.diff(ordered, prepend=-1))
    unique = ordered[first]
    # A 0/1 matrix times the blocks sums them without a sorted copy of all of them.
    gather = sparse.csr_matrix(
        (np.ones(len(order)), order, np.append(first, len(order))), shape=(len(unique), len(order))
    )
    data = np.asarray(gather @ blocks).reshape(-1, 3, 3)
    indptr = np.searchsorted(unique, np.arange(n_points + 1) * n_points)
    shape = (3 * n_points, 3 * n_points)
    return sparse.bsr_matrix((data, unique % n_points, indptr), shape=shape).tocsr()
