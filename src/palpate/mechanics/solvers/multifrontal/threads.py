"""BLAS on one thread each while several threads of ours call it."""

from __future__ import annotations

import functools
import threading
from collections.abc import Iterator
from contextlib import contextmanager

import threadpoolctl

__all__ = ["blas_on_one_thread"]


@functools.cache
def _libraries() -> threadpoolctl.ThreadpoolController:
    return threadpoolctl.ThreadpoolController()


class _Users:
    """How many calls rely on the limit at the moment; the first sets it, the last lifts it."""

    def __init__(self) -> None:
        self.lock = threading.Lock()
        self.number = 0
        self.limit: threadpoolctl.threadpool_limits | None = None


_users = _Users()


@contextmanager
def blas_on_one_thread() -> Iterator[None]:
    """While this lasts, in any thread, BLAS computes each call on one thread; afterwards as before.

    OpenBLAS takes longer to share the small products of a factorisation than to compute them.
    """
    with _users.lock:
        if _users.number == 0:
            _users.limit = _libraries().limit(limits=1, user_api="blas")
        _users.number += 1
    try:
        yield
    finally:
        with _users.lock:
            _users.number -= 1
            if _users.number == 0 and _users.limit is not None:
                _users.limit.restore_original_limits()
                _users.limit = None
