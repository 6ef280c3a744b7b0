"""Points whose motion was measured, as a page draws them: some of many, evenly, with what is said of all."""

from __future__ import annotations

from itertools import accumulate, groupby
from operator import attrgetter

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from palpate.body.provenance import pair_names
from palpate.report.pairs import ImagePair
from palpate.report.report_data import (
    MOST_ARROWS,
    LaterImage,
    MeasuredPoints,
    MeasuredState,
    Reference,
    SliceBox,
)
from palpate.report.surfaces import carried_outline
from palpate.statement.estimation import PointFit
from palpate.statement.result import CaseResult

OF_BOX = 0.1  # of the slices' longest edge: how long an arrow is drawn that is longer than all but some
USUAL = 95.0  # per cent of the arrows that are no longer than that
LARGEST_FACTOR = 1000.0
ALONE_MM = 10.0  # how near a slice lies a point that has no neighbour
AROUND_MM = 5.0
HALVINGS = 40
STATE = attrgetter("state")


def measured_states(
    result: CaseResult,
    pairs: tuple[ImagePair, ...],
    references: tuple[Reference, ...],
    later: dict[tuple[int, int], LaterImage],
    *,
    most: int,
) -> tuple[MeasuredState, ...]:
    """The later states of drawn pairs in which points were measured, at the most `most`; later: images by their place.

    Raises `ValueError` where a motion is no number.
    """
    counts = [len(names) for _, names in pair_names(result.case)]
    first = [0, *accumulate(counts)]
    found = list[MeasuredState]()
    for state, fits in groupby(sorted(result.estimation.points, key=STATE), key=STATE):
        pair = int(np.searchsorted(first, state, side="right")) - 1
        if pair < len(references) and len(found) < most:
            after = state - first[pair]
            drawn = later.get((pair, after))
            outlines = drawn.outlines if drawn else ()
            if drawn is None:  # a body without later images, as the fit moves it
                own = pairs[pair].result
                meshed = [each for each in references[pair].surfaces if result.tissues[each.tissue].meshed]
                outlines = tuple(carried_outline(own, surface, after) for surface in meshed)
            name = pair_names(result.case)[pair][1][after]
            points = tuple(measured_points(fit) for fit in fits)
            # slices through the middle of the points, and arrows that can be seen
            rest = np.concatenate([of.rest for of in points]).astype(np.float64)
            low, high = rest.min(axis=0) - AROUND_MM, rest.max(axis=0) + AROUND_MM
            slices = references[pair].slices
            if slices is not None:
                low, high = np.minimum(low, slices.low), np.maximum(high, slices.high)
            size, box = float((high - low).max()), SliceBox(low, high, np.median(rest, axis=0))
            ways = ([of.observed for of in points], [of.fitted - of.observed for of in points])
            lengths = [np.linalg.norm(np.concatenate(way), axis=1).astype(np.float64) for way in ways]
            factors = [nice_factor(of, size) for of in lengths]
            found.append(MeasuredState(name, pair, box, points, outlines, *factors))
    return tuple(found)


def measured_points(fit: PointFit) -> MeasuredPoints:
    """What is said of all points of one kind of data, and those of them that are drawn, the worst one among them."""
    motions = fit.motions
    left = np.linalg.norm(motions.fitted - motions.observed, axis=1)
    worst = int(left.argmax())
    shown = np.union1d(evenly(motions.rest, MOST_ARROWS - 1), [worst])
    places = motions.rest[shown]
    apart = np.asarray(
        cKDTree(places).query(places, k=[2])[0]
    )  # of the nearest other one; infinite where there is none
    return MeasuredPoints(
        name=fit.name,
        total=len(motions.rest),
        rest=places.astype(np.float32),
        observed=motions.observed[shown].astype(np.float32),
        fitted=motions.fitted[shown].astype(np.float32),
        near_mm=float(np.median(apart)) if len(places) > 1 else ALONE_MM,
        moved_rms_mm=float(np.sqrt(np.mean(np.sum(motions.observed**2, axis=1)))),
        left_rms_mm=float(np.sqrt(np.mean(left**2))),
        misfit=fit.misfit,
        largest_mm=float(left[worst]),
        largest_at=motions.rest[worst].astype(np.float64),
        largest_label=motions.labels[worst] if motions.labels else "",
    )


def evenly(points: NDArray[np.float64], most: int) -> NDArray[np.int64]:
    """Numbers (k,), sorted, of at most `most` points (n, 3) mm: one of each cell of a grid, the nearest to its middle.

    The grid is the finest, found by bisection of its edge, that has no more cells with points.
    """
    if len(points) <= most:
        return np.arange(len(points))
    size = float(np.ptp(points, axis=0).max())
    low, high = 0.0, 2.0 * size
    for _ in range(HALVINGS):
        edge = 0.5 * (low + high)
        low, high = (edge, high) if len(_one_a_cell(points, edge)) > most else (low, edge)
    return _one_a_cell(points, high)


def nice_factor(lengths: NDArray[np.float64], size: float) -> float:
    """The largest of 1, 2, 5, 10, ... 1000 by which most lengths (n,) mm stay under a share of `size` (mm)."""
    usual = float(np.percentile(lengths, USUAL))
    wanted = OF_BOX * size / usual if usual > 0.0 else 1.0
    steps = [digit * 10.0**power for power in range(4) for digit in (1.0, 2.0, 5.0)]
    return max([step for step in steps if step <= min(wanted, LARGEST_FACTOR)], default=1.0)


def _one_a_cell(points: NDArray[np.float64], edge: float) -> NDArray[np.int64]:
    scaled = (points - points.min(axis=0)) / edge
    cells = np.floor(scaled).astype(np.int64)
    away = np.linalg.norm(scaled - cells - 0.5, axis=1)
    order = np.lexsort((away, *cells.T))
    first = np.ones(len(points), dtype=bool)
    first[1:] = (np.diff(cells[order], axis=0) != 0).any(axis=1)
    return np.sort(order[first])
