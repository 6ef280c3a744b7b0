"""The noise model of residuals: how large they are and how far they are correlated."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import nnls
from scipy.spatial import cKDTree
from scipy.spatial.distance import cdist

from palpate.parallel import mapped

__all__ = ["EXACT_NOISE", "SEGMENTATION_NOISE", "NoiseModel", "fit_noise_model", "mean_noise"]

LENGTHS = (0.5, 0.8, 1.2, 2.0, 3.0, 4.5, 6.5, 9.5, 14.0)  # mm
CELL = 1.0  # mm: residuals nearer than that are averaged before they are compared
MAX_CELLS = 2500
CELLS = 2**20  # along an axis, before they are counted from 0 again
ROWS = 256  # of the pairs' table at once: it stays in the cache
REACH = 28.0  # mm
BINS = 1 + int(REACH)  # of a cell with itself, then of 1 mm each
FLOOR = 1e-3  # mm: no surface in an image is known better


@dataclass(frozen=True, slots=True)
class NoiseModel:
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

    @property
    def key(self) -> tuple[float, ...]:
        """Its numbers, by which two are the same."""
        return (*self.variances.tolist(), *self.lengths.tolist())

    def covariance(
        self, rows: NDArray[np.float64], places: NDArray[np.float64], normals: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """A C A^T (n_rows, n_rows) for A = `rows` (n_rows, n) on residuals at places and normals (n, 3).

        Residuals within half a correlation length are summed first.
        """

        def term(of: tuple[float, float]) -> NDArray[np.float64]:
            """That of one variance and its length."""
            variance, length = of
            _, inverse = _cell_keys(places, 0.5 * length)
            count = np.bincount(inverse)
            centres = np.stack([np.bincount(inverse, places[:, a]) / count for a in range(3)], axis=1)
            # sum of rows times normals in cells (n_rows, n_cells, 3)
            carried = np.stack(
                [np.stack([np.bincount(inverse, row * normals[:, a]) for a in range(3)], axis=1) for row in rows]
            ).astype(np.float64)
            tree = cKDTree(centres)
            pairs = tree.sparse_distance_matrix(tree, 3.5 * length, output_type="coo_matrix").tocsr()
            pairs.data = np.exp(-(pairs.data**2) / (2.0 * length**2))
            pairs.setdiag(1.0)
            total = np.zeros((len(rows), len(rows)))
            for axis in range(3):
                total += variance * carried[:, :, axis] @ np.asarray(pairs @ carried[:, :, axis].T)
            return total

        return np.asarray(np.sum(mapped(term, zip(self.variances, self.lengths, strict=True)), axis=0))


def mean_noise(models: Sequence[NoiseModel]) -> NoiseModel:
    """The noise whose covariance is the mean of those of several models; equal ones count, and cost, as one."""
    distinct = {model.key: model for model in models}
    counts = Counter(model.key for model in models)
    shares = [counts[key] / len(models) for key in distinct]
    variances = [share * model.variances for share, model in zip(shares, distinct.values(), strict=True)]
    return NoiseModel(np.concatenate(variances), np.concatenate([model.lengths for model in distinct.values()]))


EXACT_NOISE = NoiseModel(np.array([0.03**2]), np.array([3.0]))  # of surfaces that no image has rounded
SEGMENTATION_NOISE = NoiseModel(np.array([0.3**2]), np.array([3.0]))  # of segmentations of which nothing is known


def fit_noise_model(
    values: Sequence[NDArray[np.float64]], places: Sequence[NDArray[np.float64]], normals: Sequence[NDArray[np.float64]]
) -> NoiseModel:
    """Fit the model to residuals (n,) mm of several surfaces at places (n, 3) mm with normals (n, 3).

    Mean products of residuals in bins of distance, fitted by non-negative least squares to Gaussians of fixed lengths
    (0.5 to 14 mm). Residuals below 0.001 mm tell no more: they are independent ones of that size.
    """
    sums = sum(
        mapped(lambda of: _binned_products(*of), zip(values, places, normals, strict=True)),
        np.zeros((4, BINS)),
    )
    products, cosines, distances, count = sums[:, sums[3] > 0]
    weight = np.sqrt(count)
    # (n_bins, n_lengths)
    kernels = np.exp(-((distances / count)[:, None] ** 2) / (2.0 * np.square(LENGTHS)))
    variances, _ = nnls(weight[:, None] * kernels, weight * products / cosines)
    kept = variances > 0.0
    if variances.sum() < FLOOR**2:
        return NoiseModel(np.array([FLOOR**2]), np.array([1.0]))
    return NoiseModel(variances[kept], np.array(LENGTHS)[kept])


def _binned_products(
    values: NDArray[np.float64], places: NDArray[np.float64], normals: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Sums (4, n_bins) over pairs of cells, those of a cell with itself first: r_i r_j n_i.n_j, (n_i.n_j)^2, mm, 1.

    A cell (1 mm; at most 2500 of them) stands for the means of its residuals, places and normals.
    """
    keys, inverse = _cell_keys(places, CELL)
    count = np.bincount(inverse)
    mean = np.bincount(inverse, values) / count
    centre = np.stack([np.bincount(inverse, places[:, a]) / count for a in range(3)], axis=1)
    normal = np.stack([np.bincount(inverse, normals[:, a]) / count for a in range(3)], axis=1)
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-12)
    chosen = np.sort(np.argsort(_scattered(keys), kind="stable")[:MAX_CELLS])
    mean, centre, normal = mean[chosen], centre[chosen], normal[chosen]
    sums = np.zeros((4, BINS))
    for start in range(0, len(mean), ROWS):
        rows, others = slice(start, start + ROWS), slice(start, None)
        distance = cdist(centre[rows], centre[others])
        once = np.triu(distance < REACH)  # a pair of different cells once, then counted twice
        apart = distance[once]
        bins = np.where(apart > 0.0, 1 + apart.astype(np.int64), 0)
        cosine = (normal[rows] @ normal[others].T)[once]
        terms = (np.outer(mean[rows], mean[others])[once] * cosine, cosine**2, apart, np.ones_like(apart))
        sums += np.stack([np.bincount(bins, term, minlength=BINS) for term in terms])
    return sums * np.where(np.arange(BINS) > 0, 2.0, 1.0)


def _scattered(keys: NDArray[np.int64]) -> NDArray[np.uint64]:
    """Numbers (n,) that follow from the keys (n,) but without order (the finaliser of SplitMix64; Steele et al. 2014).

    Cells chosen by them stay chosen when others come and go, so that the fit does not jump as a surface moves.
    """
    mixed = keys.astype(np.uint64)
    for shift, factor in ((30, 0xBF58476D1CE4E5B9), (27, 0x94D049BB133111EB)):
        mixed = (mixed ^ (mixed >> np.uint64(shift))) * np.uint64(factor)
    return np.asarray(mixed ^ (mixed >> np.uint64(31)))


def _cell_keys(places: NDArray[np.float64], size: float) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """A key for each cube of edge `size` (mm) that holds places (n, 3) mm, and the number of each place's cube (n,)."""
    cell = np.floor(places / size).astype(np.int64) % CELLS
    keys = (cell[:, 0] * CELLS + cell[:, 1]) * CELLS + cell[:, 2]
    unique, inverse = np.unique(keys, return_inverse=True)
    return unique, np.asarray(inverse.ravel())
