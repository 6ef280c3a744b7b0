"""Independent work on several processors: NumPy, SciPy and libigl leave Python's lock while they compute."""

from __future__ import annotations

import os
import re
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

__all__ = ["mapped", "processors"]

Item = TypeVar("Item")
Result = TypeVar("Result")


def processors() -> int:
    """Processors that this process may use, and that the linear algebra's own limit leaves."""
    seen = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    limits = [os.environ.get(name, "") for name in ("OMP_NUM_THREADS", "MKL_NUM_THREADS")]
    return min([seen, *(int(limit) for limit in limits if re.fullmatch("[1-9][0-9]{0,5}", limit))])


def mapped(function: Callable[[Item], Result], items: Iterable[Item]) -> list[Result]:
    """Results of `function` for each item, in their order, by as many threads as there are `processors`.

    The first exception that a call raises is raised.
    """
    if processors() == 1:
        return [function(item) for item in items]
    with ThreadPoolExecutor(max_workers=processors()) as pool:
        return list(pool.map(function, items))
