"""What the file of a mesh holds, before anything is numbered anew."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from palpate.errors import InputDataError

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
        firsts = np.cumsum([0, *(len(rows) for _, rows in self.blocks)])
        chosen = [(rows[:, :corners], n) for n, (kind, rows) in zip(firsts, self.blocks, strict=False) if kind in kinds]
        rows = np.concatenate([np.zeros((0, corners), dtype=np.int64), *(rows for rows, _ in chosen)])
        numbers = [first + np.arange(len(own)) for own, first in chosen]
        return rows.astype(np.int64), np.concatenate([np.zeros(0, dtype=np.int64), *numbers])


def places(numbers: Numbers, wanted: Numbers, of: str) -> Numbers:
    """Where each of the `wanted` (...) stands in `numbers` (n,), from 0; raises `InputDataError` where one does not."""
    missing = np.setdiff1d(wanted, numbers)
    if len(missing):
        raise InputDataError(f"it names {len(missing)} {of} that it has not, the first of the number {missing[0]}")
    order = np.argsort(numbers, kind="stable")
    return np.asarray(order[np.searchsorted(numbers, wanted, sorter=order)])
