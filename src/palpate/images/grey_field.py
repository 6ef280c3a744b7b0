"""What a displacement field found from grey images could tell of each tissue, by their gradients and their noise.

A displacement d of N voxels changes grey values by g . d, with the gradient g. Two images with noise of the covariance
C tell it with the variance 2 sum_t C(t) R(t) / (N R(0)^2) along an axis, where R is the autocovariance of g. R is that
between voxels of one tissue and others `APART` voxels away, whose noise is independent and adds nothing to a product.
Noise is what differences between voxels tend to as their distance l does to 0: half of their variance is
s^2 (1 - r(l)) + a l^2 where the tissue is smooth. With r = 0 from two voxels on, l = 2 and 3 give s and a, l = 1 gives
r(1) along each axis, and C(t) = s^2 r_x^|t_x| r_y^|t_y| r_z^|t_z|.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product
from typing import Any

import numpy as np
from numpy.typing import NDArray

from palpate.images.label_image import VoxelGrid
from palpate.images.segmentation import Segmentation

APART, REACH, INSIDE = 3, 2, 2  # voxels: to another one; lags of covariances; to the tissue's border
SAMPLES, FEWEST = 20_000, 50  # voxels of a tissue
MAD = 1.4826  # standard deviations in a median absolute deviation
LEAST, TINY = 0.1, 1e-30  # of 1 - r(1); of a variance
SURE = 2.0  # standard errors of a gradient's square: one that is smaller may be nothing
MEAN_ML = 1.0  # volume whose mean displacement is told
LIKE = 27.0  # voxels around one, whose products of gradients are alike


@dataclass(frozen=True, slots=True)
class GreyField:
    """What grey values tell of a tissue: noise (their unit), gradient (per mm), and errors of motions (mm).

    mean_mm: standard deviation of the mean displacement of 1 mL along an axis; wave_mm: of the amplitude of a wave of
    20 mm in the whole tissue. at_least: the gradient is no larger than its own error, and both are larger than stated.
    """

    tissue: str
    noise: float
    gradient: float
    mean_mm: float
    wave_mm: float
    at_least: bool

    @property
    def in_words(self) -> str:
        """A row of the table."""
        more = "more than " if self.at_least else ""
        return (
            f"noise {self.noise:.3g}, gradient {self.gradient:.2g} per mm; a field would tell the mean motion of 1 mL"
            f" to {more}{self.mean_mm:.2g} mm, a wave of 20 mm to {more}{self.wave_mm:.2g} mm"
        )


@dataclass(frozen=True, slots=True)
class _Grey:
    """A grey image with the tissues of a segmentation, which may have another grid."""

    values: NDArray[Any]
    grid: VoxelGrid
    labels: Segmentation

    def at(self, places: NDArray[np.int64]) -> NDArray[np.float64]:
        """Values (n,) at voxels (n, 3)."""
        return np.asarray(self.values[tuple(places.T)], dtype=np.float64)

    def all_in(self, tissue: int, places: NDArray[np.int64]) -> NDArray[np.bool_]:
        """Which voxels (n, 3) lie in a tissue, with those `INSIDE` them."""
        turn = np.linalg.inv(self.labels.grid.affine) @ self.grid.affine
        found = np.ones(len(places), dtype=bool)
        for offset in np.concatenate(
            [np.zeros((1, 3), int), INSIDE * np.eye(3, dtype=int), -INSIDE * np.eye(3, dtype=int)]
        ):
            index = np.rint((places + offset) @ turn[:3, :3].T + turn[:3, 3]).astype(np.int64)
            there = ((index >= 0) & (index < self.labels.index.shape)).all(axis=1)
            found &= there
            found[found] = self.labels.index[tuple(index[found].T)] == tissue
        return found

    def gradient(self, places: NDArray[np.int64], axis: int) -> NDArray[np.float64]:
        """Central differences (n,) per mm along an axis of the grid."""
        step = np.eye(3, dtype=int)[axis]
        return (self.at(places + step) - self.at(places - step)) / (2.0 * float(self.grid.spacing[axis]))


def grey_fields(
    before: tuple[NDArray[Any], VoxelGrid, Segmentation],
    after: tuple[NDArray[Any], VoxelGrid, Segmentation] | None = None,
) -> tuple[GreyField, ...]:
    """What a field between two grey images would tell of each meshed tissue with enough voxels and some noise.

    before, after: values (n_x, n_y, n_z), their grid, and the tissues. Without the second one its noise is that of the
    first.
    """
    first, second = _Grey(*before), None if after is None else _Grey(*after)
    found = []
    for number, tissue in enumerate(first.labels.tissues):
        with np.errstate(invalid="ignore", over="ignore"):  # of values that are no numbers, which have no row
            own = _covariances(first, number) if tissue.meshed else None
            other = None if second is None else _covariances(second, number)
        if own is None:
            continue
        volume = float(np.count_nonzero(first.labels.mask(number)) * first.labels.grid.voxel_volume) / 1e3
        found.append(_field(tissue.name, own, other or own, 1e3 * MEAN_ML / first.grid.voxel_volume, volume))
    return tuple(of for of in found if 0.0 < of.mean_mm < np.inf)  # not of an image without noise, or with NaN


@dataclass(frozen=True, slots=True)
class _Covariances:
    """Of noise and of the gradient along one axis at lags (n_lags,), and the standard error of its mean square."""

    noise: NDArray[np.float64]
    gradient: NDArray[np.float64]
    error: float


def _covariances(grey: _Grey, tissue: int) -> _Covariances | None:
    """Those of a tissue; None where it has too few voxels far enough from its border."""
    grid, labels, every = grey.grid, grey.labels, np.flatnonzero(grey.labels.mask(tissue))
    sparse = max(len(every) / SAMPLES, 1.0)
    if sparse > 1.0:
        every = np.random.default_rng(0).choice(every, SAMPLES, replace=False)
    voxels = np.stack(np.unravel_index(every, labels.index.shape), axis=1).astype(np.float64)
    places = np.unique(np.rint(grid.index(labels.grid.world(voxels))).astype(np.int64), axis=0)
    margin = APART + REACH + 1
    places = places[((places >= margin) & (places < np.array(grid.shape) - margin)).all(axis=1)]
    places = places[grey.all_in(tissue, places)]
    lags = [(i, j, k) for i, j, k in product(range(-REACH, REACH + 1), repeat=3)]
    gradient, n_gradient, errors = np.zeros(len(lags)), 0, list[float]()
    noises, alike = list[float](), np.zeros(3)
    for axis in range(3):
        step = np.eye(3, dtype=int)[axis]
        away = APART * step
        own = places[grey.all_in(tissue, places + away)]
        if len(own) < FEWEST:
            continue
        halves = [_half_variance(grey.at(own + lag * step) - grey.at(own)) for lag in (1, 2, 3)]
        bend = max(halves[2] - halves[1], 0.0) / 5.0
        noises.append(max(halves[1] - 4.0 * bend, 0.0))
        alike[axis] = 1.0 - min(max((halves[0] - bend) / max(noises[-1], TINY), LEAST), 1.0)
        for along in {0, 1, 2} - {axis}:
            slope = grey.gradient(own, along)
            gradient += [np.mean(slope * grey.gradient(own + away + lag, along)) for lag in np.array(lags)]
            errors.append(
                float(np.std(slope * grey.gradient(own + away, along)) / np.sqrt(len(own) * min(sparse / LIKE, 1.0)))
            )
            n_gradient += 1
    if not n_gradient:
        return None
    error = float(np.linalg.norm(errors)) / n_gradient
    noise = float(np.mean(noises)) * np.prod(alike ** np.abs(lags), axis=1)
    return _Covariances(noise, gradient / n_gradient, error)


def _half_variance(differences: NDArray[np.float64]) -> float:
    """Half of the variance by the median absolute deviation: few differences lead across a border in the tissue."""
    return 0.5 * (MAD * float(np.median(np.abs(differences - np.median(differences))))) ** 2


def _field(name: str, own: _Covariances, other: _Covariances, voxels: float, volume_ml: float) -> GreyField:
    """What is told of a tissue of a volume, of which `voxels` are `MEAN_ML`."""
    noise, here = 0.5 * (own.noise + other.noise), len(own.noise) // 2  # the lag 0 is in the middle
    square, at_least = own.gradient[here], own.gradient[here] < SURE * own.error
    square = max(square, SURE * own.error, TINY)
    plain = noise[here] * square
    carried = plain if at_least else max(float(noise @ own.gradient), plain)
    mean = float(np.sqrt(2.0 * carried / (voxels * square**2)))
    wave = mean * float(np.sqrt(2.0 * MEAN_ML / volume_ml))  # of which the mean square is a half
    return GreyField(name, float(np.sqrt(noise[here])), float(np.sqrt(square)), mean, wave, bool(at_least))
