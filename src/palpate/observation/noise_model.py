"""The noise model of residuals: how large they are and how far they are correlated."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.optimize import nnls
from scipy.spatial import cKDTree
from scipy.spatial.distance import cdist

from palpate.observation.jacobian import Jacobian
from palpate.parallel import mapped

LENGTHS = (0.5, 0.8, 1.2, 2.0, 3.0, 4.5, 6.5, 9.5, 14.0)  # mm
CELL, FAR_CELL = 1.0, 3.0  # mm, edges of the cells over which residuals are averaged before pairs are compared
CELLS = 2**20  # along an axis, after which cells are counted from 0 again
NEAR, REACH = 8, 28  # mm: pairs beyond the first distance are of large cells, pairs beyond the second are left out
BINS = 1 + REACH  # one for a cell with itself, then one for each mm
FLOOR = 1e-3  # mm, the least standard deviation of a surface in an image
SMOOTH = 4.0  # mm: the fit hardly mistakes errors with shorter correlation for motion
CUTOFF = 3.5  # correlation lengths beyond which errors count as independent
WITHIN = 1.0  # correlation lengths, edge of the cells in which errors are summed for the fit's response
SUMMED = 2.0  # mm, edge of the cells in which errors are summed for a covariance
RESPONSE_CELLS = 400  # largest number of a surface's cells for which the fit's response is computed
NEIGHBOURS = 12
AT_ONCE = 256  # means whose neighbours' distances are computed together: some 40 MB
GROWTH = 1.15  # of the number of points from one block to the next
LEAST = 1e-3  # least conditional variance given the neighbours, over the unconditional one


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

    def covariance(
        self, rows: NDArray[np.float64], places: NDArray[np.float64], normals: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """A C A^T (n_rows, n_rows) for A = `rows` (n_rows, n) on residuals at places and normals (n, 3).

        Residuals are summed first in cells of 2 mm, but of half a correlation length at the least, of one at the most.
        """

        def term(of: tuple[float, float]) -> NDArray[np.float64]:
            """That of one variance and its length."""
            variance, length = of
            return variance * _correlated(
                *_carried(rows, places, normals, float(np.clip(SUMMED, 0.5 * length, length))), length
            )

        return np.asarray(np.sum(mapped(term, zip(self.variances, self.lengths, strict=True)), axis=0))


def mean_noise(models: Sequence[NoiseModel]) -> NoiseModel:
    """The noise whose covariance is the mean of those of several models; terms of one length are one."""
    lengths, which = np.unique(np.concatenate([model.lengths for model in models]), return_inverse=True)
    variances = np.concatenate([model.variances for model in models]) / len(models)
    return NoiseModel(np.asarray(np.bincount(which, variances), dtype=np.float64), lengths)


EXACT_NOISE = NoiseModel(np.array([0.03**2]), np.array([3.0]))  # of surfaces that no image has rounded
SEGMENTATION_NOISE = NoiseModel(np.array([0.3**2]), np.array([3.0]))  # of segmentations of which nothing is known


@dataclass(frozen=True, slots=True)
class FitResponse:
    """How a fit answers to errors e of all residuals: its unknowns move by -G e, which leaves residuals e - J G e.

    jacobians: J (n, n_unknowns) of each surface's residuals; gains: G^T (n, n_unknowns) by the errors of each surface
    at its places (n, 3) mm with normals (n, 3).
    """

    jacobians: Sequence[Jacobian]
    gains: Sequence[Jacobian]
    places: Sequence[NDArray[np.float64]]
    normals: Sequence[NDArray[np.float64]]

    def left(
        self, lengths: Sequence[float], surfaces: Sequence[tuple[NDArray[np.float64], NDArray[np.float64]]]
    ) -> NDArray[np.float64]:
        """The kernels (BINS, n_lengths) of what is left of errors of variance 1 and each correlation length (mm).

        (1 - J G) K (1 - J G)^T in bins of distance, by places and normals (n, 3) of each of the surfaces; nan where a
        bin has no pair.
        """
        seen = [_Pairs.of(*surface, j) for surface, j in zip(surfaces, self.jacobians, strict=True)]
        cosines = sum((np.bincount(pairs.bins, pairs.cosine**2, minlength=BINS) for pairs in seen), np.zeros(BINS))
        products = np.stack(mapped(lambda length: self._products(length, seen), lengths), axis=1)
        there = np.broadcast_to(cosines[:, None], products.shape)
        return np.asarray(np.divide(products, there, out=np.full(products.shape, np.nan), where=there > 0.0))

    def _products(self, length: float, seen: Sequence[_Pairs]) -> NDArray[np.float64]:
        """Sums (BINS,) of what is left in each pair, times n_i.n_j."""
        centres, carried = self._carried(WITHIN * length)
        by_errors, tree = _correlated(centres, carried, length), cKDTree(centres)  # G K G^T
        products = np.zeros(BINS)
        for pairs in seen:
            near = cKDTree(pairs.places).sparse_distance_matrix(tree, CUTOFF * length, output_type="coo_matrix").tocsr()
            near.data = _gaussian(near.data, length)
            along = [_times(near, part.T).T * pairs.normals[:, a] for a, part in enumerate(carried)]
            pulled = np.sum(along, axis=0)  # G K
            taken = pairs.jacobian @ (pulled - 0.5 * by_errors @ pairs.jacobian.T)
            left = _gaussian(pairs.distance, length) * pairs.cosine - (taken + taken.T)[pairs.near]
            products += np.bincount(pairs.bins, left * pairs.cosine, minlength=BINS)
        return products

    def _carried(self, size: float) -> tuple[NDArray[np.float64], list[NDArray[np.float64]]]:
        """Centres (n_cells, 3) mm of cubes of edge `size`, and sums of G (n_unknowns, n_cells) times each normal."""
        cells, centres = _cubes(np.concatenate(self.places), size)
        ends = np.cumsum([len(places) for places in self.places])
        parts = [sparse.csc_matrix(cells)[:, e - len(n) : e] for e, n in zip(ends, self.normals, strict=True)]
        every = list(zip(parts, self.gains, self.normals, strict=True))
        along = [
            sum((gain.summed(sparse.csr_matrix(part.multiply(n[:, a]))) for part, gain, n in every), np.zeros(()))
            for a in range(3)
        ]
        return centres, [np.ascontiguousarray(sums.T) for sums in along]


@dataclass(frozen=True, slots=True)
class _Pairs:
    """Cells of a surface and its pairs of them that are compared: `near` (n_cells, n_cells) of all, the others (n,)."""

    places: NDArray[np.float64]
    normals: NDArray[np.float64]
    jacobian: NDArray[np.float64]
    near: NDArray[np.bool_]
    distance: NDArray[np.float64]
    cosine: NDArray[np.float64]
    bins: NDArray[np.int64]

    @classmethod
    def of(cls, places: NDArray[np.float64], normals: NDArray[np.float64], jacobian: Jacobian) -> _Pairs:
        """Of residuals at places (n, 3) mm with normals (n, 3) and a Jacobian (n, n_unknowns)."""
        cells = _some_cell_means(places, RESPONSE_CELLS)
        centres, mean_normals = _times(cells, places), _units(_times(cells, normals))
        apart = cdist(centres, centres)
        near = apart < REACH
        distance, cosine = apart[near], (mean_normals @ mean_normals.T)[near]
        return cls(centres, mean_normals, jacobian.summed(cells), near, distance, cosine, _bins(distance))


def fit_noise_model(
    values: Sequence[NDArray[np.float64]],
    places: Sequence[NDArray[np.float64]],
    normals: Sequence[NDArray[np.float64]],
    response: FitResponse | None = None,
) -> NoiseModel:
    """Fit the model to residuals (n,) mm of several surfaces at places (n, 3) mm with normals (n, 3).

    Mean products of residuals in bins of distance, fitted by non-negative least squares to Gaussians of fixed lengths
    (0.5 to 14 mm). Residuals below 0.001 mm tell no more: they are independent ones of that size. With a `response` the
    products are compared with those that a fit leaves of such errors, E[r r^T] = (1 - J G) C (1 - J G)^T: smooth errors
    are taken for motion, and what is left seems smaller and shorter (variance components; Patterson & Thompson,
    Biometrika 58 (1971) 545-554, whose likelihood is of what a fit leaves, too).
    """
    sums = sum(
        mapped(lambda of: _binned_products(*of), zip(values, places, normals, strict=True)),
        np.zeros((4, BINS)),
    )
    seen = sums[3] > 0
    products, cosines, distances, count = sums[:, seen]
    weight = np.sqrt(count)
    # (n_bins, n_lengths)
    kernels = np.stack([_gaussian(distances / count, length) for length in LENGTHS], axis=1)
    if response is not None:
        smooth, surfaces = np.flatnonzero(np.array(LENGTHS) > SMOOTH), list(zip(places, normals, strict=True))
        left = response.left([LENGTHS[m] for m in smooth], surfaces)[seen]
        kernels[:, smooth] = np.where(np.isfinite(left), left, kernels[:, smooth])
    variances, _ = nnls(weight[:, None] * kernels, weight * products / cosines)
    kept = variances > 0.0
    if variances.sum() < FLOOR**2:
        return NoiseModel(np.array([FLOOR**2]), np.array([1.0]))
    return NoiseModel(variances[kept], np.array(LENGTHS)[kept])


def _binned_products(
    values: NDArray[np.float64], places: NDArray[np.float64], normals: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Sums (4, n_bins) over pairs of cells, those of a cell with itself first: r_i r_j n_i.n_j, (n_i.n_j)^2, mm, 1.

    A cell holds the means of its residuals, places and normals. Pairs less than 8 mm apart are of cells of 1 mm. Others
    are of cells of 3 mm, because 3 mm hardly change their distance; each counts as many times as it has cells of 1 mm.
    """
    cells = _cell_means(places, CELL)
    mean, centre, normal = _times(cells, values), _times(cells, places), _units(_times(cells, normals))
    near = _pair_sums(mean, centre, normal, np.ones(len(mean)), (0, NEAR))
    cells, count = _cell_means(centre, FAR_CELL), np.bincount(_cell_keys(centre, FAR_CELL)[1])
    far = _times(cells, mean), _times(cells, centre), _units(_times(cells, normal))
    sums = near + _pair_sums(*far, count.astype(np.float64), (NEAR, REACH))
    sums[:, 0] = mean @ mean, len(mean), 0.0, len(mean)
    return sums


def _pair_sums(
    values: NDArray[np.float64],
    centres: NDArray[np.float64],
    normals: NDArray[np.float64],
    counts: NDArray[np.float64],
    between: tuple[int, int],
) -> NDArray[np.float64]:
    """The part of `_binned_products` by pairs of cells at these distances (mm), each counted `counts` (n_cells,) times.

    values (n_cells,) mm, centres (n_cells, 3) mm, normals (n_cells, 3). A pair counts twice.
    """
    i, j = np.ascontiguousarray(cKDTree(centres).query_pairs(between[1], output_type="ndarray").T)
    apart = _apart(centres, i, j)
    if between[0]:
        i, j, apart = (of[apart >= between[0]] for of in (i, j, apart))
    cosine = np.sum([n[i] * n[j] for n in np.ascontiguousarray(normals.T)], axis=0)
    bins, count = _bins(apart), counts[i] * counts[j]
    terms = (values[i] * values[j] * cosine, cosine**2, apart, np.ones_like(apart))
    return np.stack([2.0 * np.bincount(bins, count * term, minlength=BINS)[:BINS] for term in terms])


def _apart(places: NDArray[np.float64], i: NDArray[np.int64], j: NDArray[np.int64]) -> NDArray[np.float64]:
    """Distances (n,) mm of pairs i, j (n,) of places (n_places, 3) mm; axis by axis, which takes half of the time."""
    return np.asarray(np.sqrt(sum((x[i] - x[j]) ** 2 for x in np.ascontiguousarray(places.T))))


def _cell_means(places: NDArray[np.float64], size: float) -> sparse.csr_matrix[np.float64]:
    """Means (n_cells, n) over what lies in each cube of edge `size` (mm), places (n, 3) mm."""
    inverse = _cell_keys(places, size)[1]
    shares = 1.0 / np.bincount(inverse)[inverse]
    return sparse.csr_matrix((shares, (inverse, np.arange(len(inverse)))))


def _some_cell_means(places: NDArray[np.float64], most: int) -> sparse.csr_matrix[np.float64]:
    """Those of cells of 1 mm, but of so many of them at the most.

    A hash of their keys chooses them (the finaliser of SplitMix64; Steele et al. 2014). So a cell stays chosen when
    others come and go, and the fit does not jump as a surface moves.
    """
    mixed = _cell_keys(places, CELL)[0].astype(np.uint64)
    for shift, factor in ((30, 0xBF58476D1CE4E5B9), (27, 0x94D049BB133111EB)):
        mixed = (mixed ^ (mixed >> np.uint64(shift))) * np.uint64(factor)
    chosen = np.sort(np.argsort(mixed ^ (mixed >> np.uint64(31)), kind="stable")[:most])
    return sparse.csr_matrix(_cell_means(places, CELL)[chosen])


def _times(
    cells: sparse.csr_matrix[np.float64] | sparse.coo_matrix[np.float64], values: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Product of a sparse matrix (m, n), mostly of cells, with values (n,) or (n, k)."""
    return np.asarray(cells @ values, dtype=np.float64)


def _carried(
    rows: NDArray[np.float64], places: NDArray[np.float64], normals: NDArray[np.float64], size: float
) -> tuple[NDArray[np.float64], list[NDArray[np.float64]]]:
    """Centres (n_cells, 3) mm of cubes of edge `size`; sums of rows (n_rows, n) times each component of the normals.

    The sums are (n_rows, n_cells) for each axis.
    """
    cells, centres = _cubes(places, size)
    return centres, [np.ascontiguousarray(_times(cells, (rows * normals[:, a]).T).T) for a in range(3)]


def _cubes(places: NDArray[np.float64], size: float) -> tuple[sparse.csr_matrix[np.float64], NDArray[np.float64]]:
    """Sums (n_cells, n) over the places (n, 3) mm in each cube of edge `size`, and their centres (n_cells, 3) mm."""
    _, inverse = _cell_keys(places, size)
    entries = (np.ones(len(inverse)), (inverse, np.arange(len(inverse))))
    cells: sparse.csr_matrix[np.float64] = sparse.csr_matrix(entries)
    return cells, _times(cells, places) / np.bincount(inverse)[:, None]


def _gaussian(distance: NDArray[np.float64], length: float) -> NDArray[np.float64]:
    """Correlation exp(-d^2 / (2 length^2)) at distances d, mm."""
    return np.asarray(np.exp(-(distance**2) / (2.0 * length**2)))


def _correlated(
    centres: NDArray[np.float64], carried: Sequence[NDArray[np.float64]], length: float
) -> NDArray[np.float64]:
    """Sum over axes of A K A^T (n_rows, n_rows), A = `carried` (n_rows, n_cells), cells at centres (n_cells, 3) mm."""
    i, j = cKDTree(centres).query_pairs(CUTOFF * length, output_type="ndarray").T
    once = sparse.coo_matrix((_gaussian(_apart(centres, i, j), length), (i, j)), shape=(len(centres),) * 2)
    parts = [(part @ _times(once, part.T), part @ part.T) for part in carried]
    return np.asarray(sum((across + across.T + own for across, own in parts), np.zeros(())))


def _units(vectors: NDArray[np.float64]) -> NDArray[np.float64]:
    """Vectors (n, 3) with length 1."""
    return np.asarray(vectors / np.maximum(np.linalg.norm(vectors, axis=1, keepdims=True), 1e-12))


def _bins(distance: NDArray[np.float64]) -> NDArray[np.int64]:
    """The bin (n,) of cells so far apart (n,) mm."""
    return np.asarray(np.where(distance > 0.0, 1 + distance.astype(np.int64), 0))


def _cell_keys(places: NDArray[np.float64], size: float) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """A key for each cube of edge `size` (mm) that holds places (n, 3) mm, and the number of each place's cube (n,)."""
    cell = np.floor(places / size).astype(np.int64) % CELLS
    keys = (cell[:, 0] * CELLS + cell[:, 1]) * CELLS + cell[:, 2]
    unique, inverse = np.unique(keys, return_inverse=True)
    return unique, np.asarray(inverse.ravel())


def correlation(distance: NDArray[np.float64], length: float) -> NDArray[np.float64]:
    """Correlation exp(-d / length) (n,), of any shape, at distances d (n,) mm; of independent errors for a length of 0.

    It falls at once: errors are never believed to be so smooth that what is finer than them is known without error.
    """
    if length <= 0.0:
        return np.asarray(distance == 0.0, dtype=np.float64)
    return np.asarray(np.exp(-distance / length))


def whitener(groups: NDArray[np.float64], length: float) -> sparse.csr_matrix[np.float64]:
    """Sparse W (n, n), dimensionless, with W C W^T = 1 nearly, for C of the means of errors of variance 1.

    groups (n, k, 3) mm: the points of each mean. Each mean is conditioned on the nearest of those before it, in an
    order that leaves no place out for long (Vecchia, J. R. Statist. Soc. B 50 (1988) 297-312; Katzfuss & Guinness,
    Statist. Sci. 36 (2021) 124-141).
    """
    n, centres = len(groups), groups.mean(axis=1)
    order = np.random.default_rng(0).permutation(n)
    rows, columns, values = list[NDArray[np.int64]](), list[NDArray[np.int64]](), list[NDArray[np.float64]]()
    start = 0
    while start < n:  # all points of a block are conditioned on those before it
        end = min(int(GROWTH * start) + 1, n)
        block, k = order[start:end], min(NEIGHBOURS, start)
        near = np.zeros((len(block), 0), dtype=np.int64)
        if k:
            tree = cKDTree(centres[order[:start]])
            near = order[:start][tree.query(centres[block], k=k)[1].reshape(len(block), k)]
        together = np.concatenate([near, block[:, None]], axis=1)
        parts = [together[first : first + AT_ONCE] for first in range(0, len(together), AT_ONCE)]
        covariance = np.concatenate([_covariance(groups[part], length) for part in parts])
        across, own = covariance[:, :k, k:], covariance[:, k, k]
        weights = np.linalg.solve(covariance[:, :k, :k] + 1e-10 * np.eye(k), across)[:, :, 0]
        left = np.maximum(own - np.einsum("nk,nk->n", weights, across[:, :, 0]), LEAST * own)
        scaled = np.concatenate([-weights, np.ones((len(block), 1))], axis=1) / np.sqrt(left)[:, None]
        rows.append(np.repeat(block, k + 1))
        columns.append(together.ravel())
        values.append(scaled.ravel())
        start = end
    entries = (np.concatenate(values), (np.concatenate(rows), np.concatenate(columns)))
    return sparse.csr_matrix(entries, shape=(n, n))


def _covariance(points: NDArray[np.float64], length: float) -> NDArray[np.float64]:
    """Covariance (n, k, k) of the means of groups of points (n, k, m, 3) mm whose errors have the variance 1.

    Squared distances are |x|^2 + |y|^2 - 2 x.y about the middle of the points.
    """
    n, k, m, _ = points.shape
    flat = points.reshape(n, k * m, 3)
    flat = flat - flat.mean(axis=1, keepdims=True)
    squares = np.einsum("npi,npi->np", flat, flat)
    apart = squares[:, :, None] + squares[:, None, :] - 2.0 * flat @ np.swapaxes(flat, 1, 2)
    same = np.arange(k * m)
    apart[:, same, same] = 0.0
    distance = np.sqrt(np.maximum(apart, 0.0))
    return np.asarray(correlation(distance, length).reshape(n, k, m, k, m).mean(axis=(2, 4)))
