"""Whether measured displacements lead from the first image to the later one, by the organs that both show."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from palpate.errors import InputDataError
from palpate.images.segmentation import Segmentation

__all__ = ["refuse_direction"]

MOST_POINTS = 20_000
TELLING = 20  # points whose tissue tells where they went
CLEARLY = 0.25  # share of these by which another reading must agree better
LPS = np.array([-1.0, -1.0, 1.0])
SLIPS = {
    "from the later image to the first; give the field that maps the first image to the later one": -np.ones(3),
    "in LPS where RAS is read; give axes = 'LPS', or 'RAS' where that is stated already": LPS,
    "from the later image to the first, and in LPS": -LPS,
}


def refuse_direction(
    points: NDArray[np.float64],
    moved: NDArray[np.float64],
    before: Segmentation,
    after: Segmentation,
    path: Path,
) -> None:
    """Raise `InputDataError` where displacements (n, 3) mm of points (n, 3) mm lead into the wrong tissues.

    Those points tell whose place shows another tissue in the later image: they must arrive in their own.
    """
    step = -(-len(points) // MOST_POINTS)
    some, way = points[::step], moved[::step]
    own = _tissue(before, some)
    telling = (own >= 0) & (_tissue(after, some) != own)
    if np.count_nonzero(telling) < TELLING:
        return
    some, way, own = some[telling], way[telling], own[telling]

    def agreement(signs: NDArray[np.float64]) -> float:
        """Share of the points that arrive in their own tissue."""
        return float(np.mean(_tissue(after, some + signs * way) == own))

    plain = agreement(np.ones(3))
    words, best = max(((words, agreement(signs)) for words, signs in SLIPS.items()), key=lambda found: found[1])
    if best > plain + CLEARLY:
        raise InputDataError(
            f"the displacements of '{path}' bring {plain:.0%} of the points that change their place into their own"
            f" tissue, and {best:.0%} if they are taken to be {words}"
        )


def _tissue(image: Segmentation, points: NDArray[np.float64]) -> NDArray[np.int64]:
    """Index (n,) of the tissue at points (n, 3) mm; -1 outside of the image."""
    index = np.rint(image.grid.index(points)).astype(np.int64)
    inside = np.all((index >= 0) & (index < image.grid.shape), axis=1)
    found = np.full(len(points), -1, dtype=np.int64)
    found[inside] = image.index[tuple(index[inside].T)]
    return found
