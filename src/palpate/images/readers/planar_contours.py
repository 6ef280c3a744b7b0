"""Closed contours on planes made voxels. Heights are in slices from the first, contours (n, 2) in rows and columns.

A pixel is inside when its centre is, or lies on a contour: programs that trace masks put contours through the centres
of the outermost voxels. A slice without a plane of its own is interpolated by distances from the outlines (Raya &
Udupa, IEEE Trans. Med. Imaging 9 (1990) 32); a body ends half the planes' distance beyond its last plane.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

Contour = NDArray[np.float64]
ON_EDGE = 0.01  # of a voxel: rounding of contours, which are written with some six digits
ON_SLICE = 0.05  # slices between a plane and the slice that it was drawn on
SAME = 0.2  # of a voxel, between the points of a contour and those of its copy, which may be rounded
WITHIN = 0.95  # share of a contour's pixels in another one, above which it is a hole
FILLED = 3.05  # of the planes' distance: larger gaps between planes are not filled
INTERPOLATED, EMPTY, JOINED = "interpolated", "left empty, far from the next plane", "joined, for contours cross there"
STEP, MOST_STEPS = 0.25, 4000  # pixels between points along an edge, from which distances are measured


@dataclass(frozen=True, slots=True)
class _Plane:
    """A plane's pixels `area` (n_rows, n_columns), its contours, and whether some cross each other."""

    area: NDArray[np.bool_]
    contours: Sequence[Contour]
    crossed: bool

    def depth(self, places: NDArray[np.int64]) -> NDArray[np.float64]:
        """Pixels (n,) from places (n, 2) to the nearest contour."""
        starts = np.concatenate(self.contours)
        steps = np.concatenate([np.roll(contour, -1, axis=0) for contour in self.contours]) - starts
        count = np.clip(np.ceil(np.linalg.norm(steps, axis=1) / STEP), 1, MOST_STEPS).astype(int)
        edge = np.repeat(np.arange(len(count)), count)
        share = (np.arange(len(edge)) - np.repeat(np.cumsum(count) - count, count)) / count[edge]
        return np.asarray(KDTree(starts[edge] + share[:, None] * steps[edge]).query(places)[0])


def distinct(contours: Sequence[Contour]) -> list[Contour]:
    """The contours of one plane, each once: a copy has the same points, in whichever order, up to rounding."""
    boxes = np.array([[*contour.min(axis=0), *contour.max(axis=0)] for contour in contours])
    kept: list[int] = []
    for number, contour in enumerate(contours):
        alike = np.flatnonzero(np.abs(boxes[kept] - boxes[number]).max(axis=1, initial=0.0) <= SAME)
        pairs = [(contours[kept[k]], contour) for k in alike]
        if not any(max(np.max(KDTree(x).query(y)[0]) for x, y in ((a, b), (b, a))) <= SAME for a, b in pairs):
            kept.append(number)
    return [contours[number] for number in kept]


def body(
    heights: NDArray[np.float64], planes: Sequence[Sequence[Contour]], shape: tuple[int, ...], *, exclusive: bool
) -> tuple[NDArray[np.bool_], dict[str, list[int]]]:
    """Voxels (n_slices, n_rows, n_columns) of planes at ascending `heights` (n,), and slices that are not as drawn.

    exclusive: contours that cross each other are not joined, but exclude each other.
    """
    plane = lru_cache(maxsize=2)(lambda number: _drawn(planes[number], shape[1:], exclusive=exclusive))
    inside = np.zeros(shape, dtype=bool)
    noted: dict[str, list[int]] = {INTERPOLATED: [], EMPTY: [], JOINED: []}
    apart = float(np.median(np.diff(heights))) if len(heights) > 1 else 1.0
    for k in range(shape[0]):
        above, nearest = int(np.searchsorted(heights, k)), int(np.argmin(np.abs(heights - k)))
        away, held = abs(float(heights[nearest]) - k), 0 < above < len(heights)
        gap = float(heights[above] - heights[above - 1]) if held else 0.0
        part = min(1.0, 0.5 * apart + 0.5 - away)  # of the slice, as far as the last plane reaches
        if away <= ON_SLICE:
            inside[k] = plane(nearest).area
            noted[JOINED] += [k] * plane(nearest).crossed
        elif held and gap <= FILLED * max(apart, 1.0):
            inside[k] = _between(plane(above - 1), plane(above), (k - float(heights[above - 1])) / gap)
            noted[INTERPOLATED].append(k)
        elif part > ON_SLICE:
            inside[k] = _deepest(plane(nearest), part)
        elif held:
            noted[EMPTY].append(k)
    return inside, noted


def _between(first: _Plane, second: _Plane, share: float) -> NDArray[np.bool_]:
    """The pixels at `share` of the way from one to the other; those of the nearer where there are none in between."""
    nearer = first if share <= 0.5 else second
    if not (first.area.any() and second.area.any()):
        return nearer.area
    found = first.area & second.area
    places = np.argwhere(first.area ^ second.area)
    here, there = (1.0 - share) * first.depth(places), share * second.depth(places)
    found[tuple(places.T)] = np.where(first.area[tuple(places.T)], here >= there, here <= there)
    return found if found.any() else nearer.area


def _deepest(plane: _Plane, part: float) -> NDArray[np.bool_]:
    """That part of the pixels, those furthest from the outline."""
    places = np.argwhere(plane.area)
    kept = places[np.argsort(-plane.depth(places), kind="stable")[: round(part * len(places))]]
    found = np.zeros_like(plane.area)
    found[tuple(kept.T)] = True
    return found


def _drawn(contours: Sequence[Contour], shape: tuple[int, ...], *, exclusive: bool) -> _Plane:
    """A plane (n_rows, n_columns): a contour in another one is a hole, one in a hole an island."""
    found, crossed = np.zeros(shape, dtype=bool), False
    for contour in sorted(contours, key=lambda of: -float(np.prod(np.ptp(of, axis=0)))):
        low = np.clip(np.floor(contour.min(axis=0)) - 1, 0, shape).astype(int)
        high = np.clip(np.ceil(contour.max(axis=0)) + 2, 0, shape).astype(int)
        if (high <= low).any():
            continue
        part = found[low[0] : high[0], low[1] : high[1]]  # is changed in place
        grown, shrunk = (_pixels(contour - low, part.shape, margin=margin) for margin in (ON_EDGE, -ON_EDGE))
        count, shared = np.count_nonzero(grown), np.count_nonzero(grown & part)
        if shared >= WITHIN * count:
            part ^= shrunk
        elif exclusive:
            part ^= grown
        else:
            part |= grown
            crossed |= bool(shared > (1.0 - WITHIN) * count)
    return _Plane(found, contours, crossed)


def _pixels(contour: Contour, shape: tuple[int, ...], *, margin: float) -> NDArray[np.bool_]:
    """Pixels (n_rows, n_columns) with centres inside of the contour, and on it where the margin is not negative.

    Every edge cuts lines just above and below each row's centres; every second piece of such a line is inside.
    """
    ends = np.roll(contour, -1, axis=0)
    low, high = np.minimum(contour[:, 0], ends[:, 0]), np.maximum(contour[:, 0], ends[:, 0])
    steps = np.zeros((shape[0], shape[1] + 1), dtype=np.int64)
    for nudge in (-ON_EDGE, ON_EDGE):
        first, last = (np.clip(np.ceil(rows - nudge), 0, shape[0]).astype(int) for rows in (low, high))
        edge = np.repeat(np.arange(len(first)), last - first)
        row = np.arange(len(edge)) - np.repeat(np.cumsum(last - first) - last, last - first)
        (y, x), (dy, dx) = contour[edge].T, (ends - contour)[edge].T
        column = x + (row + nudge - y) / dy * dx
        order = np.lexsort((column, row))
        for place, sign in ((np.ceil(column - margin), 1), (np.floor(column + margin) + 1, -1)):
            turn = order[(1 - sign) // 2 :: 2]
            np.add.at(steps, (row[turn], np.clip(place[turn], 0, shape[1]).astype(int)), sign)
    return np.asarray(np.cumsum(steps, axis=1)[:, :-1] >= (1 if margin >= 0.0 else 2))
