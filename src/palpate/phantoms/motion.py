"""How walls move: fillings of hollow organs, smooth random fields, affine motion."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from palpate.errors import GeometryError
from palpate.images.segmentation import Segmentation
from palpate.images.tissue import Role
from palpate.phantoms.shapes import Tube

ENDS = 2.2  # half the organ's length over the filling's length: the ends move by 9 % of the largest motion
BLOCK = 2**17  # products of waves and points that are computed together: they fit into the cache


class WallMotion(Protocol):
    """A smooth displacement of a wall."""

    def at(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Displacement (n, 3) mm at wall points (n, 3) in RAS mm."""
        ...


@dataclass(frozen=True, slots=True)
class Filling:
    """A tube that fills: its wall moves away from the middle line, most at one place, as a smooth function of position.

    s (mm) is the position along the unit vector `axis` (3,) from `origin` (3,) mm. The middle line is the parabola
    m(s) = origin + s axis + bend (s / length_mm)^2, bend (3,) mm. e is (x - m(s)) / radius_mm without its part along
    the axis. Then u = A(s) (filling_mm (1 + lean e . towards) / (1 + lean) e + stray(x)) with
    A(s) = exp(-(s - fullest_mm)^2 / (2 length_mm^2)) and the unit vector towards (3,).
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
    """The filling of a tube, whose middle line is the least-squares parabola through the tube's knots.

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
    """Share (n, 1), dimensionless, of the motion along spokes (n, 3): 1 along `towards` (3,), less opposite to it."""
    return np.asarray((1.0 + lean * spokes @ towards[:, None]) / (1.0 + lean))


def wall_filling(segmentation: Segmentation, tissue: int, *, filling_mm: float) -> Filling:
    """The filling by `filling_mm` of the tissue with this index in the segmentation.

    The motion is largest half way between the tissue's middle and the tenth of its voxels that are nearest to the
    centre of the first `estimate` tissue. Without such a tissue it is largest in the middle.

    The middle line is the least-squares parabola through the voxels along their longest axis. The radius R is that of
    a round tube with the same spread across, R^2 = 2 mean r^2. Raises `GeometryError` for fewer than ten voxels.
    """
    voxels = segmentation.grid.world(np.argwhere(segmentation.mask(tissue)).astype(float))
    if len(voxels) < 10:
        raise GeometryError(
            f"'{segmentation.tissues[tissue].name}' has {len(voxels)} voxels: too few to fill; check its label"
        )
    centre = voxels.mean(axis=0)
    axis = np.linalg.eigh((voxels - centre).T @ (voxels - centre))[1][:, -1]
    along = (voxels - centre) @ axis
    length = float(np.abs(along).max()) / ENDS
    aside = voxels - centre - np.outer(along, axis)
    terms = np.stack([np.ones_like(along), along / length, (along / length) ** 2], axis=1)
    shift, tilt, bend = np.linalg.lstsq(terms, aside, rcond=None)[0]
    radius = float(np.sqrt(2.0 * np.mean(np.sum((aside - terms @ np.stack([shift, tilt, bend])) ** 2, axis=1))))
    fullest, estimated = 0.0, [i for i, each in enumerate(segmentation.tissues) if each.role is Role.ESTIMATE]
    if estimated:
        organ = segmentation.grid.world(np.argwhere(segmentation.mask(estimated[0])).astype(float)).mean(axis=0)
        distance = np.linalg.norm(voxels - organ, axis=1)
        fullest = 0.5 * float(along[distance <= np.quantile(distance, 0.1)].mean())
    return Filling(
        origin=centre + shift,
        axis=axis,
        bend=bend,
        radius_mm=radius,
        filling_mm=filling_mm,
        fullest_mm=fullest,
        length_mm=length,
        towards=axis,
        lean=0.0,
        stray=smooth_field(np.random.default_rng(0), sd_mm=0.0, correlation_mm=20.0, features=1),
    )


@dataclass(frozen=True, slots=True)
class SmoothField:
    """A vector field made of plane waves.

    frequencies (n_waves, 3) rad/mm; cosines and sines (n_waves, 3) mm, the amplitude of each wave along each axis.
    """

    frequencies: NDArray[np.float64]
    cosines: NDArray[np.float64]
    sines: NDArray[np.float64]

    def at(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Field (n, 3) mm at points (n, 3) mm, exact to 1e-6: phases in double, waves in single precision."""
        turns, block = self.frequencies.T / (2.0 * np.pi), max(1, BLOCK // len(self.frequencies))
        cosines, sines = self.cosines.astype(np.float32), self.sines.astype(np.float32)
        found = np.empty((len(points), 3))
        for first in range(0, len(points), block):
            phase = points[first : first + block] @ turns
            phase = (2.0 * np.pi * (phase - np.rint(phase))).astype(np.float32)
            found[first : first + block] = np.cos(phase) @ cosines + np.sin(phase) @ sines
        return found

    def warp(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Points (n, 3) mm moved by the field."""
        return points + self.at(points)


def smooth_field(rng: np.random.Generator, *, sd_mm: float, correlation_mm: float, features: int = 2000) -> SmoothField:
    """A draw of a Gaussian random field with independent components.

    Each component has the standard deviation `sd_mm` (mm) and the correlation exp(-r^2 / (2 l^2)) between places r
    apart, l = `correlation_mm` (mm). Method: random Fourier features (Rahimi and Recht 2007), whose frequencies are
    normal with the standard deviation 1 / l.
    """
    scale = sd_mm / np.sqrt(features)
    frequencies = rng.normal(scale=1.0 / correlation_mm, size=(features, 3))
    cosines, sines = scale * rng.normal(size=(2, features, 3))
    return SmoothField(frequencies, cosines, sines)
