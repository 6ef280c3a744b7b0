"""Independent work on several processors: NumPy, SciPy and libigl leave Python's lock while they compute.

The threads are ours. BLAS's own would share each small product of an estimate among themselves, which takes longer than
to compute it, and ten times as long on a machine that does other work too: they wait for each other in a busy loop.
"""

from __future__ import annotations

import functools
import os
import re
import threading
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass
from typing import TypeVar

import threadpoolctl

__all__ = ["blas_on_one_thread", "mapped", "pool_of", "processors"]

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


@dataclass
class _Callers:
    """How many want BLAS on one thread now, and what lifts the limit."""

    number: int = 0
    limit: AbstractContextManager[object] | None = None


_callers, _turn = _Callers(), threading.Lock()


@functools.cache
def _libraries() -> threadpoolctl.ThreadpoolController:
    return threadpoolctl.ThreadpoolController()


@contextmanager
def blas_on_one_thread() -> Iterator[None]:
    """While this lasts BLAS computes each call on one thread; afterwards as before.

    The limit is one for the whole process: the first of several callers side by side sets it, the last one lifts it,
    and none waits for another, as it may be what that one waits for.
    """
    with _turn:
        if _callers.number == 0:
            _callers.limit = _libraries().limit(limits=1, user_api="blas")
        _callers.number += 1
    try:
        yield
    finally:
        with _turn:
            _callers.number -= 1
            if _callers.number == 0 and _callers.limit is not None:
                _callers.limit.__exit__(None, None, None)
                _callers.limit = None


def pool_of(threads: int) -> ThreadPoolExecutor:
    """Threads of ours, for calls inside `blas_on_one_thread`."""
    # A BLAS on OpenMP has limits of each thread's own; the thread ends before anybody else computes on it.
    return ThreadPoolExecutor(threads, initializer=lambda: _libraries().limit(limits=1, user_api="blas"))
