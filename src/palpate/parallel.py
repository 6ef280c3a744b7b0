"""Independent work on several processors: NumPy, SciPy and libigl release Python's lock while they compute.

There are as many threads as `processors` that this process may use. BLAS has one thread while they compute
(`multifrontal.blas_on_one_thread`), because more would only wait for each other. On one processor no thread is started.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from contextvars import copy_context
from typing import Any, TypeVar

from multifrontal import blas_on_one_thread, processors

__all__ = ["blas_on_one_thread", "both", "mapped", "processors"]

Item = TypeVar("Item")
Result = TypeVar("Result")


def mapped(function: Callable[[Item], Result], items: Iterable[Item]) -> list[Result]:
    """Results of `function` for each item, in their order, by as many threads as there are `processors`.

    A thread works in the caller's context, such as NumPy's settings for floating-point errors. The first exception that
    a call raises is raised.
    """
    if processors() == 1:
        return [function(item) for item in items]
    with ThreadPoolExecutor(max_workers=processors()) as pool:
        return list(pool.map(lambda item: item[0].run(function, item[1]), [(copy_context(), item) for item in items]))


def both(first: Callable[[], Item], second: Callable[[], Result]) -> tuple[Item, Result]:
    """Results of two independent calls, computed as by `mapped`."""
    calls: tuple[Callable[[], Any], Callable[[], Any]] = (first, second)
    one, other = mapped(lambda call: call(), calls)
    return one, other
