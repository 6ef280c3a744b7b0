"""Bodies given by their signed distance: ellipsoids, balls, tubes, unions and complements."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline
from scipy.spatial import KDTree

NEWTON_STEPS = 40  # for the closest point of an ellipsoid; the iteration is monotone and rarely needs ten
PLACES = 401  # along a tube's centre line, where the search for a closest point begins


class Shape(Protocol):
    """A body: signed distance (mm, negative inside) and its gradient at points (n, 3) in RAS mm."""

    def at(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Signed distance (n,) mm."""
        ...

    def gradient_at(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Gradient (n, 3), mm per mm."""
        ...


def rotation_about(axis: NDArray[np.float64], degrees: float) -> NDArray[np.float64]:
    """Matrix (3, 3) of the rotation by `degrees` about `axis` (3,), by Rodrigues' formula."""
    x, y, z = axis / np.linalg.norm(axis)
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    angle = np.deg2rad(degrees)
    return np.asarray(np.eye(3) + np.sin(angle) * cross + (1.0 - np.cos(angle)) * cross @ cross)


@dataclass(frozen=True, slots=True)
class Ellipsoid:
    """An ellipsoid: `centre` (3,) and `semi_axes` (3,) mm along the columns of `rotation` (3, 3)."""

    centre: NDArray[np.float64]
    semi_axes: NDArray[np.float64]
    rotation: NDArray[np.float64]

    def at(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Exact Euclidean signed distance (n,) mm."""
        return self.values_and_gradients(points)[0]

    def gradient_at(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Outward normal (n, 3), dimensionless, at the closest point of the surface."""
        return self.values_and_gradients(points)[1]

    def values_and_gradients(self, points: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Signed distance (n,) mm and outward normal (n, 3) at the closest point of the surface."""
        local = (points - self.centre) @ self.rotation
        closest = self._closest(local)
        distance, normal = np.linalg.norm(local - closest, axis=1), closest / self.semi_axes**2
        outside = ((local / self.semi_axes) ** 2).sum(axis=1) > 1.0
        normal = normal @ self.rotation.T / np.linalg.norm(normal, axis=1, keepdims=True)
        return np.asarray(np.where(outside, distance, -distance)), np.asarray(normal)

    def surface(self, directions: NDArray[np.float64]) -> NDArray[np.float64]:
        """Points (n, 3) mm of the surface, the images of unit `directions` (n, 3) on the unit sphere."""
        return np.asarray(self.centre + (directions * self.semi_axes) @ self.rotation.T)

    def _closest(self, local: NDArray[np.float64]) -> NDArray[np.float64]:
        """Closest surface point: q = a^2 p / (t + a^2) with sum (a p / (t + a^2))^2 = 1 (Eberly 2013)."""
        axes = self.semi_axes[:, None]  # the points come last: sums over three axes run along them
        away = np.where(local.T < 0.0, -1.0, 1.0) * np.maximum(np.abs(local.T), 1e-7 * axes)  # off the symmetry planes
        stretched, squares = axes * away, axes**2
        t = (np.abs(stretched) - squares).max(axis=0)  # below the root of a convex, decreasing function
        for _ in range(NEWTON_STEPS):
            below = t + squares
            terms = (stretched / below) ** 2
            value = terms.sum(axis=0) - 1.0
            t = t + 0.5 * value / (terms / below).sum(axis=0)
            if np.abs(value).max(initial=0.0) < 1e-13:
                break
        return np.asarray((axes * stretched / (t + squares)).T)


def ball(centre: NDArray[np.float64], radius: float) -> Ellipsoid:
    """The ball of `radius` (mm) about `centre` (3,) mm."""
    return Ellipsoid(np.asarray(centre, dtype=np.float64), np.full(3, radius), np.eye(3))


@dataclass(frozen=True, slots=True)
class Tube:
    """A tube with rounded ends around a curve through `knots` (n, 3) mm, with `radii` (n,) mm there.

    Curve and radius are cubic splines, `curve` and `radius`, of a parameter from 0 to 1. The distance is |p - c| - r at
    the closest point c of the centre line. It is exact for a constant radius, and to first order for a slowly varying
    one. Newton's method for c begins at the nearest of the `places` (n_places,), which the `tree` finds.
    """

    knots: NDArray[np.float64]
    radii: NDArray[np.float64]
    curve: CubicSpline = field(init=False)
    radius: CubicSpline = field(init=False)
    places: NDArray[np.float64] = field(init=False)
    tree: KDTree = field(init=False)

    def __post_init__(self) -> None:
        chords = np.linalg.norm(np.diff(self.knots, axis=0), axis=1)
        parameters = np.concatenate([[0.0], np.cumsum(chords) / chords.sum()])
        curve, places = CubicSpline(parameters, self.knots), np.linspace(0.0, 1.0, PLACES)
        made = {"curve": curve, "radius": CubicSpline(parameters, self.radii), "places": places}
        for name, value in (made | {"tree": KDTree(curve(places))}).items():
            object.__setattr__(self, name, value)

    def at(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Signed distance (n,) mm."""
        place, spoke = self.coordinates(points)
        return np.asarray(np.linalg.norm(spoke, axis=1) - self.radius(place))

    def gradient_at(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Gradient (n, 3), mm per mm: (p - c) / |p - c| - r' grad s at the place s of the closest point c."""
        return self.values_and_gradients(points)[1]

    def values_and_gradients(self, points: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Signed distance (n,) mm and its gradient (n, 3), mm per mm."""
        place, spoke = self.coordinates(points)
        slope, bend = self._bend(place, spoke)
        narrowing = np.where((place > 0.0) & (place < 1.0), self.radius(place, 1) / bend, 0.0)  # none at the ends
        length = np.linalg.norm(spoke, axis=1)
        gradient = spoke / np.maximum(length, 1e-12)[:, None] - narrowing[:, None] * slope
        return np.asarray(length - self.radius(place)), np.asarray(gradient)

    def coordinates(self, points: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Place (n,) of the closest point on the centre line, 0 to 1, and the vector (n, 3) mm from there."""
        place = self.places[self.tree.query(points)[1]]
        for _ in range(3):  # Newton on (p - c) . c' = 0
            spoke = points - self.curve(place)
            slope, bend = self._bend(place, spoke)
            place = np.clip(place + np.einsum("ni,ni->n", spoke, slope) / bend, 0.0, 1.0)
        return np.asarray(place), np.asarray(points - self.curve(place))

    def _bend(
        self, place: NDArray[np.float64], spoke: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Slopes c' (n, 3) mm and |c'|^2 - (p - c) . c'' (n,) mm^2, at least |c'|^2 / 5, at places (n,)."""
        slope = self.curve(place, 1)
        square = np.einsum("ni,ni->n", slope, slope)
        bend = square - np.einsum("ni,ni->n", spoke, self.curve(place, 2))
        return slope, np.asarray(np.maximum(bend, 0.2 * square))

    def surface(self, directions: NDArray[np.float64]) -> NDArray[np.float64]:
        """Points (n, 3) mm of the surface, in unit `directions` (n, 3) from places all along the centre line."""
        place = np.linspace(0.0, 1.0, len(directions))
        points = self.curve(place) + self.radius(place)[:, None] * directions
        for _ in range(2):
            distance, gradient = self.values_and_gradients(points)
            points = points - distance[:, None] * gradient
        return np.asarray(points)


@dataclass(frozen=True, slots=True)
class Union:
    """What lies in any of `parts`."""

    parts: Sequence[Shape]

    def at(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Signed distance (n,) mm; inside an overlap a lower bound of its depth."""
        return np.asarray(np.min([part.at(points) for part in self.parts], axis=0))

    def gradient_at(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Gradient (n, 3), mm per mm, of the nearest part."""
        nearest = np.argmin([part.at(points) for part in self.parts], axis=0)
        gradients = np.stack([part.gradient_at(points) for part in self.parts])
        return np.asarray(gradients[nearest, np.arange(len(points))])


@dataclass(frozen=True, slots=True)
class Complement:
    """What lies outside `part`."""

    part: Shape

    def at(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Signed distance (n,) mm."""
        return -self.part.at(points)

    def gradient_at(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Gradient (n, 3), mm per mm."""
        return -self.part.gradient_at(points)
