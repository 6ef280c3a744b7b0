"""Measured displacements of points of the body, of markers or of a field: an `Observation`."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from palpate.mesh.locate import Places, point_interpolation
from palpate.mesh.space import LagrangeSpace
from palpate.observation.contract import DataFile, Fit, PointMotions, Residuals, Weighting
from palpate.observation.noise_model import FitResponse, NoiseModel, whitener
from palpate.observation.robust_loss import FAR, PowerLaw

MAD = 1.4826  # standard deviations of a normal law in one median absolute deviation
ALONE = 1e-3  # mm: length over which errors that are independent are alike
FEW = 30  # residuals, of which a spread is not told
TOGETHER = 6  # points of one cell whose mean is compared, of errors that are alike


@dataclass(frozen=True, slots=True)
class PointDisplacement:
    """Residuals r = W (N u - d) of points with measured displacements d; implements `Observation`.

    interpolation: N (n, n_dofs) to the points, or to means of several; measured: d (n,) mm; whitening: W (n, n), which
    makes their errors independent, each with the standard deviation stated. material (n, 3) mm: the point that a
    residual is of; axes (n, 3): along which; labels (n / 3,): names of the points, () where they have none.
    """

    kind: str
    description: str
    name: str
    dofs: NDArray[np.int64]
    interpolation: sparse.csr_matrix[np.float64]
    measured: NDArray[np.float64]
    whitening: sparse.csr_matrix[np.float64]
    material: NDArray[np.float64]
    axes: NDArray[np.float64]
    observed_share: float
    stated: NoiseModel
    noise_model: NoiseModel
    weighting: Weighting
    labels: tuple[str, ...] = ()

    @property
    def unit(self) -> str:
        """Millimetre."""
        return "mm"

    @property
    def of_driver(self) -> bool:
        """It shows no wall."""
        return False

    def residuals(self, displacement: NDArray[np.float64], offset: float = 0.0) -> Residuals:
        """Residuals and their derivative at displacements (n,) mm of the points; linear, and without an `offset`."""
        n = len(self.measured)
        values = np.asarray(self.whitening @ (displacement - self.measured)) + offset
        weights = np.full(n, 1.0 / n)
        motions = self.point_motions(displacement)
        away = np.linalg.norm(motions.fitted - motions.observed, axis=1)
        return Residuals(values, weights, self.material, self.axes, self.material, self.whitening, away)

    def point_motions(self, displacement: NDArray[np.float64]) -> PointMotions:
        """The points, or means of some, as measured and at their displacements (n,) mm."""
        return PointMotions(self.material[::3], self.measured.reshape(-1, 3), displacement.reshape(-1, 3), self.labels)

    def with_noise(self, noise: NoiseModel) -> PointDisplacement:
        """All points count, by the variance of the noise."""
        n = float(len(self.measured))
        return replace(self, noise_model=noise, weighting=Weighting(n / noise.sd**2, PowerLaw(), n))

    @property
    def sd_bounds(self) -> tuple[float, float]:
        """From what is stated on."""
        return self.stated.sd, np.inf if len(self.measured) >= FEW else self.stated.sd

    def with_sd(self, sd: float) -> PointDisplacement:
        """The same; a point that was mistaken for another counts less, the further off it is."""
        n = self.weighting.count
        return replace(self, weighting=Weighting(n / sd**2, PowerLaw(FAR * sd), n))

    def with_correlation(self, noise: NoiseModel) -> PointDisplacement:
        """The same noise: its residuals are independent."""
        return replace(self, noise_model=noise)

    def weighed(self, residuals: Residuals) -> Residuals:
        """The same: every residual counts alike."""
        return residuals

    def first_noise(self, peers: Sequence[PointDisplacement]) -> NoiseModel:
        """What is stated."""
        del peers
        return self.stated

    def fitted_noise(self, residuals: Sequence[Residuals], response: FitResponse | None = None) -> NoiseModel:
        """What is stated, or the residuals' robust spread where that is larger."""
        del response
        every = np.concatenate([found.values for found in residuals])
        spread = MAD * float(np.median(np.abs(every))) if len(every) >= FEW else 0.0
        return self.stated if spread <= self.stated.sd else NoiseModel(np.array([spread**2]), self.stated.lengths)

    def fit(self, residuals: Residuals) -> Fit:
        """Distances of the model's points to where they were measured."""
        away = np.abs(residuals.values) if residuals.distances is None else residuals.distances
        return Fit(float(away.mean()), float(np.sqrt(np.mean(away**2))), float(np.quantile(away, 0.95)), None)


def point_displacement(
    space: LagrangeSpace,
    points: NDArray[np.float64],
    moved: NDArray[np.float64],
    places: Places,
    *,
    file: DataFile,
    description: str,
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
    stated = NoiseModel(np.array([file.sd_mm**2]), np.array([ALONE]))
    return PointDisplacement(
        kind=file.name,
        description=description,
        name=file.name,
        dofs=(3 * seen[:, None] + np.arange(3)).ravel(),
        interpolation=sparse.csr_matrix(sparse.kron(of_nodes[:, seen], sparse.eye_array(3))),
        measured=np.asarray(mean @ moved).ravel(),
        whitening=sparse.csr_matrix(sparse.kron(mixed, apart)),
        material=np.repeat(np.asarray(mean @ points), 3, axis=0),
        axes=np.tile(np.eye(3), (n, 1)),
        observed_share=1.0,
        stated=stated,
        noise_model=stated,
        weighting=Weighting(3.0 * n / file.sd_mm**2, PowerLaw(), 3.0 * n),
        labels=labels,
    )


def _means(
    points: NDArray[np.float64], number: NDArray[np.int64], length: float
) -> tuple[sparse.csr_matrix[np.float64], sparse.csr_matrix[np.float64]]:
    """Means (n_cells, n) of points (n, 3) mm by the number (n,) of their cell, and what makes these independent.

    Of errors that are alike over a length (mm) some points of each cell say nearly what all of them do.
    """
    counts = np.bincount(number)
    if length <= 0.0:
        shares = (1.0 / counts[number], (number, np.arange(len(number))))
        alone = sparse.csr_matrix(sparse.diags_array(np.sqrt(counts.astype(np.float64))))
        return sparse.csr_matrix(shares, shape=(len(counts), len(points))), alone
    order, k = np.argsort(number, kind="stable"), min(TOGETHER, int(counts.max()))
    starts = np.cumsum(counts) - counts
    spread = np.arange(k) / max(k - 1, 1)  # over the points of the cell in their order; with fewer some stand twice
    groups = order[starts[:, None] + np.rint(spread * (counts[:, None] - 1)).astype(np.int64)]
    entries = (np.full(groups.size, 1.0 / k), (np.repeat(np.arange(len(groups)), k), groups.ravel()))
    return sparse.csr_matrix(entries, shape=(len(groups), len(points))), whitener(points[groups], length)
