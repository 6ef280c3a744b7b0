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
from contextlib import contextmanager
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


_turn = threading.RLock()


@functools.cache
def _libraries() -> threadpoolctl.ThreadpoolController:
    return threadpoolctl.ThreadpoolController()


@contextmanager
def blas_on_one_thread() -> Iterator[None]:
    """While this lasts BLAS computes each call on one thread; afterwards as before.

    The limit is one for the whole process: the first of several callers side by side sets it and lifts it when it ends,
    the others compute under it and wait for nobody, as they may be what the first one waits for.
    """
    if not _turn.acquire(blocking=False):
        yield
        return
    try:
        with _libraries().limit(limits=1, user_api="blas"):
            yield
    finally:
        _turn.release()


def pool_of(threads: int) -> ThreadPoolExecutor:
    """Threads of ours, for calls inside `blas_on_one_thread`."""
    # A BLAS on OpenMP has limits of each thread's own; the thread ends before anybody else computes on it.
    return ThreadPoolExecutor(threads, initializer=lambda: _libraries().limit(limits=1, user_api="blas"))
