"""What the file of a mesh holds, before anything is numbered anew."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

MOST_BYTES = 4 * 2**30
Name = int | str
Numbers = NDArray[np.int64]
Sets = Mapping[Name, Sequence[Numbers]]


@dataclass(frozen=True, slots=True)
class Elements:
    """Points (n, 3); blocks of elements of one kind, in meshio's words, (n, k) numbers of points, corners first.

    sets: elements, counted through all blocks, by the name or the number of their set, in one or several parts;
    point_sets: points. about: what else the file says of groups.
    """

    points: NDArray[np.float64]
    blocks: Sequence[tuple[str, Numbers]]
    sets: Sets = field(default_factory=dict)
    point_sets: Sets = field(default_factory=dict)
    about: str = ""

    def of(self, kinds: Sequence[str], corners: int) -> tuple[Numbers, Numbers]:
        """Corners (n, corners) of the elements of some kinds, and the number (n,) of each."""
        own = [(kind in kinds, rows) for kind, rows in self.blocks]
        corner = [np.zeros((0, corners), dtype=np.int64), *(rows[:, :corners] for chosen, rows in own if chosen)]
        number = np.flatnonzero(np.concatenate([[], *(np.full(len(rows), chosen) for chosen, rows in own)]))
        return np.concatenate(corner).astype(np.int64), number
