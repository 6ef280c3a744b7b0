"""Independent work on several processors: NumPy, SciPy and libigl leave Python's lock while they compute.

The threads are ours, as many as the `processors` that this process may use; BLAS's own only wait for each other, so
that its limit is one while ours compute (`multifrontal.blas_on_one_thread`). On one processor nothing waits for a
thread.
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

    A thread works in the caller's context: what NumPy is told to let pass there is let pass in it. The first exception
    that a call raises is raised.
    """
    if processors() == 1:
        return [function(item) for item in items]
    with ThreadPoolExecutor(max_workers=processors()) as pool:
        return list(pool.map(lambda item: item[0].run(function, item[1]), [(copy_context(), item) for item in items]))


def both(first: Callable[[], Item], second: Callable[[], Result]) -> tuple[Item, Result]:
    """Results of two calls that do not hang on each other, as `mapped` has them."""
    calls: tuple[Callable[[], Any], Callable[[], Any]] = (first, second)
    one, other = mapped(lambda call: call(), calls)
    return one, other
