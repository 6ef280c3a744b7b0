"""BLAS on one thread each while several threads of ours call it."""

from __future__ import annotations

import functools
import threading
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager

import threadpoolctl

__all__ = ["blas_on_one_thread", "pool_of"]

_turn = threading.RLock()


@functools.cache
def _libraries() -> threadpoolctl.ThreadpoolController:
    return threadpoolctl.ThreadpoolController()


@contextmanager
def blas_on_one_thread() -> Iterator[None]:
    """While this lasts BLAS computes each call on one thread; afterwards as before. One caller at a time, others wait.

    OpenBLAS takes longer to share the small products of a factorisation than to compute them. Its limit is one for the
    whole process: callers side by side would lift each other's, and each of them occupies all processors anyway.
    """
    with _turn, _libraries().limit(limits=1, user_api="blas"):
        yield


def _limit_here() -> None:
    """For a BLAS on OpenMP, whose limits are a thread's own; the thread ends before anybody else computes on it."""
    _libraries().limit(limits=1, user_api="blas")


def pool_of(threads: int) -> ThreadPoolExecutor:
    """Threads of ours, for calls inside `blas_on_one_thread`."""
    return ThreadPoolExecutor(threads, initializer=_limit_here)
