"""Rows of numbers as lines of text, as many simulators read them."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray


def rows(pattern: str, *columns: NDArray[Any]) -> str:
    """A line a row of `columns`, each (n,) or (n, k), by a `%` pattern with a place for each number."""
    parts = [column[:, None] if column.ndim == 1 else column for column in columns]
    cells = [list(map(tuple, part.tolist())) for part in parts]
    return "".join(f"{pattern % sum(row, ())}\n" for row in zip(*cells, strict=True))


def wrapped(numbers: NDArray[np.int64], *, width: int = 12) -> str:
    """Numbers (n,) with commas between them, `width` on a line."""
    return "".join(
        ", ".join(map(str, numbers[start : start + width].tolist())) + "\n" for start in range(0, len(numbers), width)
    )
