"""Measured displacements of points of the body, of markers or of a field: an `Observation`."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from palpate.mesh.locate import Places, point_interpolation
from palpate.mesh.space import LagrangeSpace
from palpate.observation.contract import DataFile, PointMotions, Residuals
from palpate.observation.noise_model import whitener
from palpate.observation.point_table import PointTable
from palpate.observation.stated_noise import StatedNoise, stated_noise
from palpate.observation.subset_mean import subset_mean

TOGETHER = 6  # largest number of points in a cell's mean where their errors are correlated


@dataclass(frozen=True, slots=True)
class PointDisplacement(StatedNoise):
    """Residuals r = W (N u - d) of points with measured displacements d; implements `Observation`.

    interpolation: N (n, n_dofs) to the points, or to means of several; measured: d (n,) mm; whitening: W (n, n), which
    makes their errors independent, each with one standard deviation; over_errors (n / 3, 3, 3), 1/mm: what makes the
    components of a point's error independent, of variance 1. material (n, 3) mm: the point that a
    residual is of, along x, y or z in turn; labels (n / 3,): names of the points, () where they have none.
    """

    description: str
    dofs: NDArray[np.int64]
    interpolation: sparse.csr_matrix[np.float64]
    measured: NDArray[np.float64]
    whitening: sparse.csr_matrix[np.float64]
    over_errors: NDArray[np.float64]
    material: NDArray[np.float64]
    labels: tuple[str, ...] = ()

    unit = "mm"

    def residuals(self, displacement: NDArray[np.float64], offset: float = 0.0) -> Residuals:
        """Residuals and their derivative at displacements (n,) mm of the points; linear, and without an `offset`."""
        n, off = len(self.measured), displacement - self.measured
        values, weights = np.asarray(self.whitening @ off) + offset, np.full(n, 1.0 / n)
        away, axes = np.linalg.norm(off.reshape(-1, 3), axis=1), np.tile(np.eye(3), (n // 3, 1))
        return Residuals(values, weights, self.material, axes, self.material, self.whitening, away)

    def point_motions(self, displacement: NDArray[np.float64]) -> PointMotions:
        """The points, or means of some, as measured and at their displacements (n,) mm."""
        measured, found = self.measured.reshape(-1, 3), displacement.reshape(-1, 3)
        return PointMotions(self.material[::3], measured, found, self.over_errors, self.labels)


def point_displacement(
    space: LagrangeSpace,
    table: PointTable,
    places: Places,
    file: DataFile,
    description: str,
    *,
    cells: NDArray[np.int64] | None = None,
    labels: tuple[str, ...] = (),
) -> PointDisplacement:
    """The term of the measured points of a table, which lie inside the mesh at `places`.

    file: what is stated of their errors beside the table; cells (n, k): what the points of one mean have in common, by
    default each stands alone; labels (n,): names of points that stand alone.
    """
    number = np.arange(len(table.before)) if cells is None else np.unique(cells, axis=0, return_inverse=True)[1].ravel()
    mean, sd, mixed = _means(table, number, file.correlation_mm or 0.0)
    of_nodes, n = sparse.csr_matrix(mean @ _interpolation(space, table, places, file, mean)), mean.shape[0]
    seen = np.unique(of_nodes.indices)
    of_one = np.asarray(mean @ table.sd)
    over_errors = np.eye(3) / of_one[:, :, None]
    if file.covariance_mm2 is not None:  # of all points
        over_errors = np.tile(np.linalg.inv(np.linalg.cholesky(file.covariance_mm2)), (n, 1, 1))
    usual = float(3.0 * np.mean(over_errors**2)) ** -0.5  # of equal errors that tell as much
    apart = sparse.bsr_array((usual * over_errors * (of_one / sd)[:, None], np.arange(n), np.arange(n + 1)))
    return PointDisplacement(
        file.name,
        *stated_noise(usual, 3 * n),
        description=description,
        dofs=(3 * seen[:, None] + np.arange(3)).ravel(),
        interpolation=sparse.csr_matrix(sparse.kron(of_nodes[:, seen], sparse.eye_array(3))),
        measured=np.asarray(mean @ table.moved).ravel(),
        whitening=sparse.csr_matrix(sparse.kron(mixed, sparse.eye_array(3)) @ apart),
        over_errors=over_errors,
        material=np.repeat(np.asarray(mean @ table.before), 3, axis=0),
        labels=labels,
    )


def _interpolation(
    space: LagrangeSpace, table: PointTable, places: Places, file: DataFile, mean: sparse.csr_matrix[np.float64]
) -> sparse.csr_matrix[np.float64]:
    """What is measured at each point that has a share in a mean: the displacement there, or that of a subset."""
    if not file.subset_mm:
        return point_interpolation(space, places)
    taken = np.isin(np.arange(len(table.before)), mean.indices)
    of_taken = subset_mean(space, table.before[taken], places.of(taken), np.array(file.subset_mm))
    return sparse.csr_matrix(sparse.eye_array(len(taken), format="csc")[:, taken] @ of_taken)


def _means(
    table: PointTable, number: NDArray[np.int64], length: float
) -> tuple[sparse.csr_matrix[np.float64], NDArray[np.float64], sparse.csr_matrix[np.float64]]:
    """Means (n_cells, n) of points by the number (n,) of their cell, weighted by the inverse squares of their errors.

    With the standard deviations (n_cells, 3) mm of their errors, and what makes these independent. Where errors are
    correlated over a length (mm), a few points of each cell tell nearly as much as all, and the error is that of one.
    """
    counts, members, row = np.bincount(number), np.arange(len(number)), number
    k = 1
    if length > 0.0:
        order, k = np.argsort(number, kind="stable"), min(TOGETHER, int(counts.max()))
        starts = np.cumsum(counts) - counts
        spread = np.arange(k) / max(k - 1, 1)  # over the cell's points; with fewer, some are taken twice
        members = order[starts[:, None] + np.rint(spread * (counts[:, None] - 1)).astype(np.int64)].ravel()
        row = np.repeat(np.arange(len(counts)), k)
    tells = 1.0 / np.mean(table.sd[members] ** 2, axis=1)
    mean = sparse.csr_matrix((tells / np.bincount(row, tells)[row], (row, members)), shape=(len(counts), len(number)))
    if length > 0.0:
        return mean, np.asarray(mean @ table.sd), whitener(table.before[members].reshape(-1, k, 3), length)
    alone = sparse.csr_matrix(sparse.eye_array(len(counts)))
    return mean, np.sqrt(mean.power(2) @ table.sd**2), alone
