"""Sparse symmetric positive definite systems by a multifrontal Cholesky factorisation on dense kernels of LAPACK.

    factor = multifrontal.factorise(matrix)
    x = factor.solve(b)

Duff & Reid, ACM TOMS 9 (1983) 302-325; Liu, SIAM Review 34 (1992) 82-109.
"""

from multifrontal.dense import blas_on_one_thread, pool_of, processors
from multifrontal.factorisation import Factor, analyse, factorise
from multifrontal.numeric import NotPositiveDefinite
from multifrontal.plan import Plan
from multifrontal.symbolic import nested_dissection, twin_rows

__all__ = [
    "Factor",
    "NotPositiveDefinite",
    "Plan",
    "analyse",
    "blas_on_one_thread",
    "factorise",
    "nested_dissection",
    "pool_of",
    "processors",
    "twin_rows",
]
