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
from palpate.observation.stated_noise import StatedNoise, stated_noise

TOGETHER = 6  # largest number of points in a cell's mean where their errors are correlated


@dataclass(frozen=True, slots=True)
class PointDisplacement(StatedNoise):
    """Residuals r = W (N u - d) of points with measured displacements d; implements `Observation`.

    interpolation: N (n, n_dofs) to the points, or to means of several; measured: d (n,) mm; whitening: W (n, n), which
    makes their errors independent, each with the standard deviation stated. material (n, 3) mm: the point that a
    residual is of, along x, y or z in turn; labels (n / 3,): names of the points, () where they have none.
    """

    description: str
    dofs: NDArray[np.int64]
    interpolation: sparse.csr_matrix[np.float64]
    measured: NDArray[np.float64]
    whitening: sparse.csr_matrix[np.float64]
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
        return PointMotions(self.material[::3], self.measured.reshape(-1, 3), displacement.reshape(-1, 3), self.labels)


def point_displacement(
    space: LagrangeSpace,
    points: NDArray[np.float64],
    moved: NDArray[np.float64],
    places: Places,
    file: DataFile,
    description: str,
    *,
    cells: NDArray[np.int64] | None = None,
    labels: tuple[str, ...] = (),
) -> PointDisplacement:
    """The term of points (n, 3) mm at rest, inside the mesh at `places`, that were measured to move by (n, 3) mm.

    file: what is stated of their errors; cells (n, k): what the points of one mean have in common, by default each
    stands alone; labels (n,): names of points that stand alone.
    """
    number = np.arange(len(points)) if cells is None else np.unique(cells, axis=0, return_inverse=True)[1].ravel()
    mean, mixed = _means(points, number, file.correlation_mm)
    of_nodes, n = sparse.csr_matrix(mean @ point_interpolation(space, places)), mean.shape[0]
    seen = np.unique(of_nodes.indices)
    apart = np.eye(3)
    if file.covariance_mm2 is not None:
        apart = file.sd_mm * np.linalg.inv(np.linalg.cholesky(file.covariance_mm2))
    return PointDisplacement(
        file.name,
        *stated_noise(file.sd_mm, 3 * n),
        description=description,
        dofs=(3 * seen[:, None] + np.arange(3)).ravel(),
        interpolation=sparse.csr_matrix(sparse.kron(of_nodes[:, seen], sparse.eye_array(3))),
        measured=np.asarray(mean @ moved).ravel(),
        whitening=sparse.csr_matrix(sparse.kron(mixed, apart)),
        material=np.repeat(np.asarray(mean @ points), 3, axis=0),
        labels=labels,
    )


def _means(
    points: NDArray[np.float64], number: NDArray[np.int64], length: float
) -> tuple[sparse.csr_matrix[np.float64], sparse.csr_matrix[np.float64]]:
    """Means (n_cells, n) of points (n, 3) mm by the number (n,) of their cell, and what makes these independent.

    Where errors are correlated over a length (mm), a few points of each cell tell nearly as much as all.
    """
    counts = np.bincount(number)
    if length <= 0.0:
        shares = (1.0 / counts[number], (number, np.arange(len(number))))
        alone = sparse.csr_matrix(sparse.diags_array(np.sqrt(counts.astype(np.float64))))
        return sparse.csr_matrix(shares, shape=(len(counts), len(points))), alone
    order, k = np.argsort(number, kind="stable"), min(TOGETHER, int(counts.max()))
    starts = np.cumsum(counts) - counts
    spread = np.arange(k) / max(k - 1, 1)  # over the cell's points; with fewer, some are taken twice
    groups = order[starts[:, None] + np.rint(spread * (counts[:, None] - 1)).astype(np.int64)]
    entries = (np.full(groups.size, 1.0 / k), (np.repeat(np.arange(len(groups)), k), groups.ravel()))
    return sparse.csr_matrix(entries, shape=(len(groups), len(points))), whitener(points[groups], length)
