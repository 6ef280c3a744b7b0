"""The law of the surfaces' residuals: how large they are and how far they are correlated."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import nnls
from scipy.spatial import cKDTree
from scipy.spatial.distance import cdist

from palpate.parallel import mapped

__all__ = ["NoiseLaw", "fit_noise_law"]

LENGTHS = (0.5, 0.8, 1.2, 2.0, 3.0, 4.5, 6.5, 9.5, 14.0)  # mm
CELL = 1.0  # mm: residuals nearer than that are averaged before they are compared
MAX_CELLS = 2500
ROWS = 256  # of the pairs' table at once: it stays in the cache
REACH = 28.0  # mm
FLOOR = 1e-3  # mm: no surface in an image is known better


@dataclass(frozen=True, slots=True)
class NoiseLaw:
    """Covariance of two residuals, C(d) n_i.n_j with C(d) = sum_m variance_m exp(-d^2 / (2 length_m^2)).

    variances (n_terms,) mm^2; lengths (n_terms,) mm; n_i.n_j is the product of the surface's normals.
    """

    variances: NDArray[np.float64]
    lengths: NDArray[np.float64]

    @property
    def sd(self) -> float:
        """Standard deviation of a residual, mm."""
        return float(np.sqrt(self.variances.sum()))

    @property
    def correlation_area(self) -> float:
        """Area that one independent residual stands for, mm^2: integral of C over a plane, by C(0)."""
        return float(2.0 * np.pi * (self.variances @ self.lengths**2) / self.variances.sum())

    def covariance(
        self, rows: NDArray[np.float64], places: NDArray[np.float64], normals: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """A C A^T (n_rows, n_rows) for A = `rows` (n_rows, n) on residuals at places and normals (n, 3).

        Residuals within half a correlation length are summed first.
        """
        total = np.zeros((len(rows), len(rows)))
        for variance, length in zip(self.variances, self.lengths, strict=True):
            carried, centres = _gather(rows, places, normals, 0.5 * length)
            tree = cKDTree(centres)
            pairs = tree.sparse_distance_matrix(tree, 3.5 * length, output_type="coo_matrix").tocsr()
            pairs.data = np.exp(-(pairs.data**2) / (2.0 * length**2))
            pairs.setdiag(1.0)
            for axis in range(3):
                total += variance * carried[:, :, axis] @ (pairs @ carried[:, :, axis].T)
        return total


def fit_noise_law(
    values: Sequence[NDArray[np.float64]], places: Sequence[NDArray[np.float64]], normals: Sequence[NDArray[np.float64]]
) -> NoiseLaw:
    """Fit the law to residuals (n,) mm of several surfaces at places (n, 3) mm with normals (n, 3).

    Mean products of residuals in bins of distance, fitted by non-negative least squares to Gaussians of fixed lengths
    (0.5 to 14 mm).
    """
    edges = np.concatenate([[0.0, 1e-6], np.arange(1.0, REACH, 1.0)])
    sums = sum(
        mapped(lambda of: _binned_products(*_cells(*of), edges), zip(values, places, normals, strict=True)),
        np.zeros((4, len(edges) - 1)),
    )
    products, cosines, distances, count = sums[:, sums[3] > 0]
    weight = np.sqrt(count)
    # (n_bins, n_lengths)
    kernels = np.exp(-((distances / count)[:, None] ** 2) / (2.0 * np.square(LENGTHS)))
    variances, _ = nnls(weight[:, None] * kernels, weight * products / cosines)
    kept = variances > 0.0
    if not kept.any():
        return NoiseLaw(np.array([FLOOR**2]), np.array([1.0]))
    return NoiseLaw(np.maximum(variances[kept], FLOOR**2), np.array(LENGTHS)[kept])


def _binned_products(
    mean: NDArray[np.float64], centre: NDArray[np.float64], normal: NDArray[np.float64], edges: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Sums (4, n_bins) over pairs of cells: r_i r_j n_i.n_j, (n_i.n_j)^2, distance (mm), 1."""
    size = len(edges) - 1
    sums = np.zeros((4, size))
    for start in range(0, len(mean), ROWS):  # a pair of different cells once, then counted twice
        rows, others = slice(start, start + ROWS), slice(start, None)
        distance = cdist(centre[rows], centre[others])
        bins = np.searchsorted(edges, distance.ravel(), side="right") - 1
        times = 2.0 * np.triu(np.ones_like(distance), 1)
        np.fill_diagonal(times, 1.0)
        inside = (bins < size) & (times.ravel() > 0.0)
        cosine = normal[rows] @ normal[others].T
        terms = (np.outer(mean[rows], mean[others]) * cosine, cosine**2, distance, np.ones_like(distance))
        weights = ((times * term).ravel()[inside] for term in terms)
        sums += np.stack([np.bincount(bins[inside], weight, minlength=size) for weight in weights])
    return sums


def _cells(
    values: NDArray[np.float64], places: NDArray[np.float64], normals: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Means of residuals, places and normals in cells of 1 mm, at most 2500 of them."""
    inverse = _cell_numbers(places, CELL)
    count = np.bincount(inverse)
    mean = np.bincount(inverse, values) / count
    centre = np.stack([np.bincount(inverse, places[:, a]) / count for a in range(3)], axis=1)
    normal = np.stack([np.bincount(inverse, normals[:, a]) / count for a in range(3)], axis=1)
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-12)
    chosen = np.random.default_rng(0).permutation(len(mean))[:MAX_CELLS]
    return mean[chosen], centre[chosen], normal[chosen]


def _gather(
    rows: NDArray[np.float64], places: NDArray[np.float64], normals: NDArray[np.float64], size: float
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Sum of rows times normals in cells, (n_rows, n_cells, 3), and the cells' centres (n_cells, 3)."""
    inverse = _cell_numbers(places, size)
    count = np.bincount(inverse)
    centre = np.stack([np.bincount(inverse, places[:, a]) / count for a in range(3)], axis=1)
    carried = np.stack(
        [np.stack([np.bincount(inverse, row * normals[:, a]) for a in range(3)], axis=1) for row in rows]
    ).astype(np.float64)
    return carried, centre


def _cell_numbers(places: NDArray[np.float64], size: float) -> NDArray[np.int64]:
    cell = np.floor((places - places.min(axis=0)) / size).astype(np.int64)
    spans = cell.max(axis=0) + 1
    keys = (cell[:, 0] * spans[1] + cell[:, 1]) * spans[2] + cell[:, 2]
    return np.asarray(np.unique(keys, return_inverse=True)[1].ravel())
