"""How the walls of hollow and rigid tissues move between the two images of a scene."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from palpate.phantoms.boundary_noise import SmoothField
from palpate.phantoms.shapes import Tube

__all__ = ["AffineMotion", "Filling", "ScaledMotion", "Swelling", "WallMotion", "filling_of"]


class WallMotion(Protocol):
    """A smooth displacement of a wall."""

    def at(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Displacement (n, 3) mm at wall points (n, 3) in RAS mm."""
        ...


@dataclass(frozen=True, slots=True)
class Filling:
    """A tube that fills: motion away from its middle line, most at one place, as a smooth function of position.

    With s (mm) along the unit vector `axis` (3,) from `origin` (3,), and the spoke e = (x - m(s)) / radius_mm from the
    parabola m(s) = origin + s axis + bend (s / length_mm)^2 (bend (3,) mm), its part along the axis left out:
    u = A(s) (filling_mm (1 + lean e . towards) / (1 + lean) e + stray(x)),
    A(s) = exp(-(s - fullest_mm)^2 / (2 length_mm^2)). towards (3,) unit vector.
    """

    origin: NDArray[np.float64]
    axis: NDArray[np.float64]
    bend: NDArray[np.float64]
    radius_mm: float
    filling_mm: float
    fullest_mm: float
    length_mm: float
    towards: NDArray[np.float64]
    lean: float
    stray: SmoothField

    def at(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Displacement (n, 3) mm at wall points (n, 3) in RAS mm."""
        along = (points - self.origin) @ self.axis
        middle = self.origin + np.outer(along, self.axis) + np.outer((along / self.length_mm) ** 2, self.bend)
        spoke = (points - middle) / self.radius_mm
        spoke = spoke - np.outer(spoke @ self.axis, self.axis)
        around = _around(spoke, self.towards, self.lean)
        amplitude = np.exp(-((along - self.fullest_mm) ** 2) / (2.0 * self.length_mm**2))[:, None]
        return np.asarray(amplitude * (self.filling_mm * around * spoke + self.stray.at(points)))


@dataclass(frozen=True, slots=True)
class ScaledMotion:
    """`factor` times another motion."""

    motion: WallMotion
    factor: float

    def at(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Displacement (n, 3) mm at wall points (n, 3) in RAS mm."""
        return self.factor * self.motion.at(points)


def filling_of(
    tube: Tube,
    *,
    filling_mm: float,
    fullest_mm: float,
    length_mm: float,
    towards: NDArray[np.float64],
    lean: float,
    stray: SmoothField,
) -> Filling:
    """The filling of a tube: its middle line is the parabola through the tube's knots, in the least squares' sense.

    Lengths in mm; towards (3,) unit vector; see `Filling`.
    """
    origin = tube.knots.mean(axis=0)
    axis = tube.knots[-1] - tube.knots[0]
    axis = axis / np.linalg.norm(axis)
    along = (tube.knots - origin) @ axis
    aside = tube.knots - origin - np.outer(along, axis)
    terms = np.stack([np.ones_like(along), (along / length_mm) ** 2], axis=1)
    shift, bend = np.linalg.lstsq(terms, aside, rcond=None)[0]
    radius = float(np.mean(tube.radii))
    return Filling(origin + shift, axis, bend, radius, filling_mm, fullest_mm, length_mm, towards, lean, stray)


@dataclass(frozen=True, slots=True)
class Swelling:
    """A ball that grows, more to one side: u = push_mm (1 + lean e . towards) / (1 + lean) e + stray(x).

    e = (x - centre) / radius_mm; centre (3,) mm, towards (3,) unit vector.
    """

    centre: NDArray[np.float64]
    radius_mm: float
    push_mm: float
    towards: NDArray[np.float64]
    lean: float
    stray: SmoothField

    def at(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Displacement (n, 3) mm at wall points (n, 3) in RAS mm."""
        spoke = (points - self.centre) / self.radius_mm
        around = _around(spoke, self.towards, self.lean)
        return np.asarray(self.push_mm * around * spoke + self.stray.at(points))


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


def _around(spokes: NDArray[np.float64], towards: NDArray[np.float64], lean: float) -> NDArray[np.float64]:
    """Share (n, 1), dimensionless, of the motion along spokes (n, 3): 1 `towards` (3,), less on the other side."""
    return np.asarray((1.0 + lean * spokes @ towards[:, None]) / (1.0 + lean))
