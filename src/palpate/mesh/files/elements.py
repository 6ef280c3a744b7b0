"""What the file of a mesh holds, before anything is numbered anew."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

MOST_BYTES = 4 * 2**30
CORNERS = {"tetra": 4, "tetra10": 4, "triangle": 3, "triangle6": 3, "node": 1}  # of what is read; the last is of sets
Name = int | str
Numbers = NDArray[np.int64]
Block = tuple[str, Numbers, Collection[Name]]


@dataclass(frozen=True, slots=True)
class Elements:
    """Points (n, 3), and blocks: kind in meshio's words, numbers (n, k) of points, corners first, and groups.

    All elements of a block are in its groups, which have a name or a number; one that is in others may stand in further
    blocks. about: what else the file says of groups.
    """

    points: NDArray[np.float64]
    blocks: Sequence[Block]
    about: str = ""
