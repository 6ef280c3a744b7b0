"""How the walls of hollow and rigid tissues move between the two images of a scene."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from palpate.phantoms.boundary_noise import SmoothField
from palpate.phantoms.shapes import Tube

__all__ = ["AffineMotion", "Filling", "WallMotion"]


class WallMotion(Protocol):
    """A smooth displacement of a wall."""

    def at(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Displacement (n, 3) mm at wall points (n, 3) in RAS mm."""
        ...


@dataclass(frozen=True, slots=True)
class Filling:
    """A tube that fills: radial motion with a smooth profile, and a little motion of any direction.

    At the place t (0 to 1) of the centre line the wall moves outwards by
    filling_mm A(t) (1 + lean e . towards) / (1 + lean), where e is the unit vector from the centre line and
    A = floor + (1 - floor) t^a (1 - t)^b / max, (a, b) = `profile`, both above 1 so that A is flat at the ends.
    towards (3,) unit vector; `stray` is added, scaled by A.
    """

    tube: Tube
    filling_mm: float
    profile: tuple[float, float]
    floor: float
    towards: NDArray[np.float64]
    lean: float
    stray: SmoothField

    def at(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Displacement (n, 3) mm at wall points (n, 3) in RAS mm."""
        place, spoke = self.tube.coordinates(points)
        outward = spoke / np.linalg.norm(spoke, axis=1, keepdims=True)
        along = self._along(place)[:, None]
        around = (1.0 + self.lean * outward @ self.towards[:, None]) / (1.0 + self.lean)
        return np.asarray(along * (self.filling_mm * around * outward + self.stray.at(points)))

    def _along(self, place: NDArray[np.float64]) -> NDArray[np.float64]:
        a, b = self.profile
        fullest = a / (a + b)
        peak = fullest**a * (1.0 - fullest) ** b
        return np.asarray(self.floor + (1.0 - self.floor) * place**a * (1.0 - place) ** b / peak)


@dataclass(frozen=True, slots=True)
class AffineMotion:
    """u(x) = gradient (x - centre) + translation: a stretch, a shear or (gradient = R - I) a rigid motion.

    gradient (3, 3) dimensionless, centre and translation (3,) mm.
    """

    gradient: NDArray[np.float64]
    centre: NDArray[np.float64]
    translation: NDArray[np.float64]

    def at(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Displacement (n, 3) mm at points (n, 3) in RAS mm."""
        return np.asarray((points - self.centre) @ self.gradient.T + self.translation)
