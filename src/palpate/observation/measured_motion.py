"""The motion of a surface as measured points tell it: what they have in common, and a Gaussian process besides."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import RBFInterpolator
from scipy.spatial import cKDTree

from palpate.errors import InputDataError
from palpate.observation.measured_points import MeasuredPoints

NEAREST = 100  # nearest measured points from which the motion of one place is computed
FEWEST = 4  # points that are needed to know how a surface moves, turns and stretches
FLAT = 1e-6  # of the points' extent: across a thinner direction the motion's change is unknown
EXACT = 1e-4  # of the motion's standard deviation, the least error that is assumed


@dataclass(frozen=True, slots=True)
class MeasuredMotion:
    """The motion that the points of one state tell, those of one source or of several, with their stated errors.

    kernel_mm, amplitude_mm: of the Gaussian process that the motion is beside its affine part.
    """

    sources: Sequence[MeasuredPoints]
    kernel_mm: float
    amplitude_mm: float

    @property
    def before(self) -> NDArray[np.float64]:
        """The points (n, 3) mm at rest."""
        return np.concatenate([source.table.before for source in self.sources])

    def apply(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Where points (m, 3) mm are afterwards, (m, 3) mm.

        An affine map fitted by least squares, and the mean of a Gaussian process given what it leaves, for which the
        `NEAREST` points are asked (Rasmussen & Williams 2006, equation 2.23). Points on a plane, or a line, leave the
        map's slope across it at 0.
        """
        before, moved = self.before, np.concatenate([source.table.moved for source in self.sources])
        sd_mm = np.concatenate([np.sqrt(np.mean(source.table.sd**2, axis=1)) for source in self.sources])
        mean = before.mean(axis=0)
        terms = [np.concatenate([x - mean, np.ones((len(x), 1))], axis=1) for x in (before, points)]
        slopes, *_ = np.linalg.lstsq(terms[0], moved, rcond=FLAT)
        process = RBFInterpolator(
            before,
            moved - terms[0] @ slopes,
            neighbors=min(NEAREST, len(before)),
            smoothing=np.maximum(sd_mm / self.amplitude_mm, EXACT) ** 2,
            kernel="gaussian",
            epsilon=1.0 / (np.sqrt(2.0) * self.kernel_mm),
            degree=-1,
        )
        return np.asarray(points + terms[1] @ slopes + process(points))

    def require(self, points: NDArray[np.float64], name: str) -> None:
        """Raise `InputDataError` where points (m, 3) mm of a surface lie further than a kernel from all measured."""
        n, distance = len(self.before), np.asarray(cKDTree(self.before).query(points)[0])
        far = np.count_nonzero(distance > self.kernel_mm)
        if n < FEWEST or far:
            place = np.round(points[int(np.argmax(distance))], 1).tolist()
            raise InputDataError(
                f"'{name}' is prescribed by {n} measured points, and {far} of its {len(points)} nodes lie more than"
                f" {self.kernel_mm:g} mm ([driver] kernel_mm) from all of them, the farthest at {place} mm; measure at"
                f" least {FEWEST} points"
                ' near it, or give it the boundary "moving"'
            )
