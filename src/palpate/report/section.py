"""Plane sections of images and surfaces, in world coordinates (RAS mm)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from palpate.images.distance import window_of
from palpate.images.label_image import VoxelGrid

PIXEL_MM = 0.8


@dataclass(frozen=True, slots=True)
class View:
    """A way of looking: `normal`, `across`, `up` are world axes; +`across` points to the viewer's left.

    letters: left, right, top, bottom of the picture, in the radiological convention.
    """

    name: str
    normal: int
    across: int
    up: int
    letters: tuple[str, str, str, str]


VIEWS = (
    View("axial", 2, 0, 1, ("R", "L", "A", "P")),
    View("coronal", 1, 0, 2, ("R", "L", "S", "I")),
    View("sagittal", 0, 1, 2, ("A", "P", "S", "I")),
)


@dataclass(frozen=True, slots=True)
class Plane:
    """The plane of `view` at `position` (mm along the normal), cut to a box `low` to `high`, (3,) mm each."""

    view: View
    position: float
    low: NDArray[np.float64]
    high: NDArray[np.float64]

    @property
    def axes(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Places of the pixels' centres across (n,) and up (m,), mm."""
        return self._ticks(self.view.across), self._ticks(self.view.up)

    @property
    def points(self) -> NDArray[np.float64]:
        """World points (n_up, n_across, 3) mm of the pixels' centres."""
        across, up = self.axes
        points = np.empty((len(up), len(across), 3))
        points[..., self.view.normal] = self.position
        points[..., self.view.across] = across
        points[..., self.view.up] = up[:, None]
        return points

    def _ticks(self, axis: int) -> NDArray[np.float64]:
        count = max(round((self.high[axis] - self.low[axis]) / PIXEL_MM), 2)
        return np.asarray(np.linspace(self.low[axis], self.high[axis], count))


def cut_image(
    values: NDArray[Any],
    grid: VoxelGrid,
    plane: Plane,
    *,
    order: Literal[0, 1] = 1,
    points: NDArray[np.float64] | None = None,
) -> NDArray[np.float64]:
    """Values (n_up, n_across) of a field (n_x, n_y, n_z) on the plane's pixels; NaN outside its grid.

    order 0: nearest voxel; points (n_up, n_across, 3) RAS mm: what the pixels show, in the place of the plane's points.
    """
    points = plane.points if points is None else points
    index = grid.index(points.reshape(-1, 3))
    window = window_of(index, grid, margin=2)
    origin = np.array([axis.start for axis in window])
    sampled = ndimage.map_coordinates(
        values[window].astype(np.float64), (index - origin).T, order=order, mode="nearest"
    )
    outside = ((index < -0.5) | (index > np.array(grid.shape) - 0.5)).any(axis=1)
    return np.asarray(np.where(outside, np.nan, sampled).reshape(points.shape[:2]))


def joined(points: NDArray[np.float64], triangles: NDArray[np.int64], plane: Plane) -> list[NDArray[np.float64]]:
    """Lines (n, 2) mm, (across, up), where triangles (n_faces, 3) of points (n, 3) mm cross it, as long as they go.

    Closed ones end where they begin.
    """
    segments, keys = cut_triangles(points, triangles, plane)
    neighbours: dict[int, list[int]] = {}
    for number, ends in enumerate(keys.tolist()):
        for end in ends:
            neighbours.setdefault(end, []).append(number)
    unused = set(range(len(keys)))
    open_ends = [ends[0] for ends in neighbours.values() if len(ends) == 1]
    lines = []
    for first in (*open_ends, *range(len(keys))):
        if first not in unused:
            continue
        unused.discard(first)
        start = 0 if len(neighbours[int(keys[first, 0])]) == 1 else 1
        line = [segments[first, start], segments[first, 1 - start]]
        end = int(keys[first, 1 - start])
        while following := [number for number in neighbours[end] if number in unused]:
            number = following[0]
            unused.discard(number)
            side = 1 if keys[number, 0] == end else 0
            line.append(segments[number, side])
            end = int(keys[number, side])
        lines.append(np.asarray(line))
    return lines


def cut_triangles(
    points: NDArray[np.float64], triangles: NDArray[np.int64], plane: Plane
) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Segments (n, 2, 2) mm of a section, and the numbers (n, 2) of the edges that their ends lie on.

    points (n_points, 3) mm, triangles (n_triangles, 3).
    """
    height = points[:, plane.view.normal] - plane.position
    height = np.where(height == 0.0, 1e-9, height)  # a node in the plane counts as just above it
    corner = height[triangles]
    pairs = np.array([[0, 1], [1, 2], [2, 0]])
    crossed = np.sign(corner[:, pairs[:, 0]]) != np.sign(corner[:, pairs[:, 1]])  # (n_faces, 3): none or two of them
    hit = crossed.any(axis=1)
    ends = np.sort(triangles[hit][:, pairs], axis=2).astype(np.int64)
    a, b = ends[..., 0], ends[..., 1]
    share = height[a] / np.where(crossed[hit], height[a] - height[b], 1.0)
    flat = points[:, [plane.view.across, plane.view.up]]
    places = flat[a] + share[..., None] * (flat[b] - flat[a])
    keys = a * len(points) + b
    return np.asarray(places[crossed[hit]].reshape(-1, 2, 2)), np.asarray(keys[crossed[hit]].reshape(-1, 2))
