"""What an estimation says: moduli with interval and verdict, every start, the fit of every surface."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

__all__ = ["Estimation", "Interval", "Iteration", "ModulusEstimate", "Remark", "Start", "SurfaceFit", "TissueFit"]

Interval = tuple[float | None, float | None]


@dataclass(frozen=True, slots=True)
class Remark:
    """A warning that stands beside a result: a `code` for programs, a `message` for readers."""

    code: str
    message: str


@dataclass(frozen=True, slots=True)
class Iteration:
    """One step of one start: misfit (mm^2), moduli (kPa, or ratios), and the decrement still promised."""

    objective_mm2: float
    moduli: Mapping[str, float]
    decrement: float


@dataclass(frozen=True, slots=True)
class Start:
    """One start: moduli (kPa, or ratios) it began and ended with; `minimum` numbers the distinct minima from 0."""

    start: Mapping[str, float]
    end: Mapping[str, float]
    objective_mm2: float
    status: str
    reason: str
    minimum: int
    history: tuple[Iteration, ...]

    @property
    def iterations(self) -> int:
        """Number of accepted points."""
        return len(self.history)


@dataclass(frozen=True, slots=True)
class ModulusEstimate:
    """Young's modulus of one tissue, in `unit` (kPa, or a ratio to `relative_to`), with its 95 % interval.

    None in an interval is an open end; `value` is None in ratio mode and when nothing converged.
    """

    tissue: str
    unit: str
    value: float | None
    interval95: Interval | None
    interval_kind: str
    relative_to: str
    ratio: float | None
    ratio_interval95: Interval | None
    verdict: str
    why: str
    truth: float | None = None
    parameter: str = "youngs_modulus"


@dataclass(frozen=True, slots=True)
class SurfaceFit:
    """Distance of the model's surface to the image's, as difference to the rest state (mm), and overlap."""

    mean_mm: float
    rms_mm: float
    hd95_mm: float
    dice: float | None


@dataclass(frozen=True, slots=True)
class TissueFit:
    """Fit of one tissue in one later image, before and after the estimation."""

    tissue: str
    start: SurfaceFit
    end: SurfaceFit
    observed_share: float


@dataclass(frozen=True, slots=True)
class Estimation:
    """Result of one inversion.

    correlation (n, n) of the log-moduli; fits: the tissues of each later image; displacements: (n_points, 3) mm of
    each later image; covariance (n, n) of the log-moduli, grid_covariance (n, n) the part of the voxel grid's place.
    """

    status: str
    reason: str
    estimates: tuple[ModulusEstimate, ...]
    covariance: NDArray[np.float64]
    starts: tuple[Start, ...]
    fits: tuple[tuple[TissueFit, ...], ...]
    displacements: tuple[NDArray[np.float64], ...]
    counts: Mapping[str, int]
    remarks: tuple[Remark, ...] = ()
    grid_covariance: NDArray[np.float64] = field(default_factory=lambda: np.zeros((0, 0)))

    @property
    def correlation(self) -> NDArray[np.float64]:
        """Correlation (n, n) of the log-moduli, dimensionless."""
        sd = np.sqrt(np.diag(self.covariance))
        return np.asarray(self.covariance / np.outer(sd, sd))
