"""Dense kernels on fronts, BLAS and LAPACK through the pointers that SciPy offers to Cython, and their threads.

Called so, they leave Python's lock while they compute; SciPy's own wrappers do not. All matrices are in Fortran's order
(columns contiguous, or parts of such), of one type, single or double; a symmetric one has its lower triangle only.

The threads are ours. BLAS's own would share each small product among themselves, which takes longer than to compute it,
and ten times as long on a machine that does other work too: they wait for each other in a busy loop.
"""

from __future__ import annotations

import ctypes
import functools
import os
import re
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass
from typing import Any

import numpy as np
import threadpoolctl
from numpy.typing import NDArray
from scipy.linalg import cython_blas, cython_lapack

__all__ = [
    "Matrix",
    "Vectors",
    "address",
    "blas_on_one_thread",
    "factor",
    "multiply_adjoint",
    "pool_of",
    "processors",
    "solve",
    "solve_adjoint",
    "solve_right",
    "solve_transposed",
    "subtract_product",
    "subtract_square",
]

Matrix = NDArray[Any]  # float32 or float64, all arguments of a call alike

_name_of = ctypes.pythonapi.PyCapsule_GetName
_name_of.restype, _name_of.argtypes = ctypes.c_char_p, [ctypes.py_object]
_pointer_of = ctypes.pythonapi.PyCapsule_GetPointer
_pointer_of.restype, _pointer_of.argtypes = ctypes.c_void_p, [ctypes.py_object, ctypes.c_char_p]


def _routine(module: Any, name: str) -> Callable[..., None]:
    """A routine of BLAS or LAPACK; all of its arguments are pointers."""
    capsule = module.__pyx_capi__[name]
    signature = _name_of(capsule)
    address = _pointer_of(capsule, signature)
    n_arguments = signature.count(b",") + 1
    return ctypes.CFUNCTYPE(None, *[ctypes.c_void_p] * n_arguments)(address)


_ROUTINES = {
    (kind, np.dtype(dtype)): _routine(module, letter + kind)
    for letter, dtype in (("s", np.float32), ("d", np.float64))
    for kind, module in [
        ("potrf", cython_lapack),
        *((k, cython_blas) for k in ("trsm", "trmm", "syrk", "gemm", "trsv", "gemv")),
    ]
}
_TYPES = (np.dtype(np.float32), np.dtype(np.float64))
_CONSTANT = {(dtype, value): np.array([value], dtype=dtype) for dtype in _TYPES for value in (-1.0, 0.0, 1.0)}
_PLACES = {key: constant.ctypes.data for key, constant in _CONSTANT.items()}


# A factor has hundreds of small fronts: what surrounds a call counts as much as the call.
def address(array: Matrix) -> int:
    """Where the first of its numbers lies."""
    return int(array.ctypes.data)


@functools.lru_cache(maxsize=1 << 14)
def _dimension(value: int) -> Any:
    return ctypes.byref(ctypes.c_int(value))


def _leading(array: Matrix) -> Any:
    return _dimension(max(array.strides[1] // array.itemsize, array.shape[0], 1))  # a single column has any stride


def _scalar(dtype: np.dtype[Any], value: float) -> int:
    return _PLACES[dtype, value]


def factor(a: Matrix) -> int:
    """L in place of the lower triangle of A = L L^T (n, n); 0, or the number from 1 of the first bad pivot."""
    info = ctypes.c_int(0)
    _ROUTINES["potrf", a.dtype](b"L", _dimension(len(a)), address(a), _leading(a), ctypes.byref(info))
    return info.value


def _triangular(side: bytes, transposed: bytes, lower: Matrix, b: Matrix, kind: str = "trsm") -> None:
    _ROUTINES[kind, b.dtype](
        side, b"L", transposed, b"N", _dimension(b.shape[0]), _dimension(b.shape[1]), _scalar(b.dtype, 1.0),
        address(lower), _leading(lower), address(b), _leading(b),
    )  # fmt: skip


def solve_transposed(lower: Matrix, b: Matrix) -> None:
    """B L^-T in place of B (m, n)."""
    _triangular(b"R", b"T", lower, b)


def solve_right(lower: Matrix, b: Matrix) -> None:
    """B L^-1 in place of B (m, n)."""
    _triangular(b"R", b"N", lower, b)


def solve(lower: Matrix, b: Matrix) -> None:
    """L^-1 B in place of B (n, k)."""
    _triangular(b"L", b"N", lower, b)


def solve_adjoint(lower: Matrix, b: Matrix) -> None:
    """L^-T B in place of B (n, k)."""
    _triangular(b"L", b"T", lower, b)


def multiply_adjoint(lower: Matrix, b: Matrix) -> None:
    """L^T B in place of B (n, k)."""
    _triangular(b"L", b"T", lower, b, "trmm")


def subtract_square(c: Matrix, a: Matrix, *, keep: float = 1.0) -> None:
    """Keep C - A A^T in place of the lower triangle of C (n, n), A (n, k); keep: 0 or 1."""
    _ROUTINES["syrk", c.dtype](
        b"L", b"N", _dimension(a.shape[0]), _dimension(a.shape[1]), _scalar(c.dtype, -1.0), address(a), _leading(a),
        _scalar(c.dtype, keep), address(c), _leading(c),
    )  # fmt: skip


def subtract_product(c: Matrix, a: Matrix, b: Matrix, *, keep: float = 1.0) -> None:
    """Keep C - A B^T in place of C (m, n), A (m, k), B (n, k); keep: 0 or 1."""
    _ROUTINES["gemm", c.dtype](
        b"N", b"T", _dimension(c.shape[0]), _dimension(c.shape[1]), _dimension(a.shape[1]), _scalar(c.dtype, -1.0),
        address(a), _leading(a), address(b), _leading(b), _scalar(c.dtype, keep), address(c), _leading(c),
    )  # fmt: skip


@dataclass(frozen=True, slots=True)
class Vectors:
    """Products of parts of a matrix with single vectors, told by addresses: views would cost more than the products.

    trsv, gemv: routines of one type; minus, zero, one: addresses of these numbers.
    """

    trsv: Callable[..., None]
    gemv: Callable[..., None]
    minus: int
    zero: int
    one: int

    @classmethod
    def of(cls, dtype: np.dtype[Any]) -> Vectors:
        """Those of matrices of single or of double precision."""
        return cls(
            _ROUTINES["trsv", dtype], _ROUTINES["gemv", dtype], *(_scalar(dtype, value) for value in (-1.0, 0.0, 1.0))
        )

    def solve(self, transposed: bool, n: int, lower: int, leading: int, x: int) -> None:
        """L^-1 x, or L^-T x, in place of x (n,), L (n, n)."""
        self.trsv(b"L", b"T" if transposed else b"N", b"N", _dimension(n), lower, _dimension(leading), x, _dimension(1))

    def subtract(
        self, transposed: bool, shape: tuple[int, int], a: int, leading: int, x: int, y: int, *, keep: bool
    ) -> None:
        """Keep y - A x, or y - A^T x, in place of y; A of `shape` (m, n)."""
        self.gemv(
            b"T" if transposed else b"N", _dimension(shape[0]), _dimension(shape[1]), self.minus, a,
            _dimension(leading), x, _dimension(1), self.one if keep else self.zero, y, _dimension(1),
        )  # fmt: skip


def processors() -> int:
    """Processors that this process may use, and that the linear algebra's own limit leaves."""
    seen = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    limits = [os.environ.get(name, "") for name in ("OMP_NUM_THREADS", "MKL_NUM_THREADS")]
    return min([seen, *(int(limit) for limit in limits if re.fullmatch("[1-9][0-9]{0,5}", limit))])


@dataclass
class _Callers:
    """How many want BLAS on one thread now, and what lifts the limit."""

    number: int = 0
    limit: AbstractContextManager[object] | None = None


_callers, _turn = _Callers(), threading.Lock()


@functools.cache
def _libraries() -> threadpoolctl.ThreadpoolController:
    return threadpoolctl.ThreadpoolController()


def _in_control() -> threadpoolctl.ThreadpoolController:
    """The libraries, whose limits this thread may set: from threadpoolctl 3.8 on one alone may, others do nothing."""
    for library in _libraries().lib_controllers:
        clear = getattr(library, "clear_controlling_thread", None)
        if clear is not None:
            clear(force=True)
    return _libraries()


@contextmanager
def blas_on_one_thread() -> Iterator[None]:
    """While this lasts BLAS computes each call on one thread; afterwards as before.

    The limit is one for the whole process: the first of several callers side by side sets it, the last one lifts it,
    and none waits for another, as it may be what that one waits for.
    """
    with _turn:
        if _callers.number == 0:
            _callers.limit = _in_control().limit(limits=1, user_api="blas")
        _callers.number += 1
    try:
        yield
    finally:
        with _turn:
            _callers.number -= 1
            if _callers.number == 0 and _callers.limit is not None:
                _in_control()
                _callers.limit.__exit__(None, None, None)
                _callers.limit = None


def pool_of(threads: int) -> ThreadPoolExecutor:
    """Threads of ours, for calls inside `blas_on_one_thread`."""
    # A BLAS on OpenMP has limits of each thread's own; the thread ends before anybody else computes on it.
    return ThreadPoolExecutor(threads, initializer=lambda: _libraries().limit(limits=1, user_api="blas"))
