"""Permutation tests: how often chance alone orders the patients as the stages did."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from itertools import permutations

import numpy as np
from numpy.typing import NDArray

__all__ = ["MOST_EXACT", "Permutation", "permutation_test"]

MOST_EXACT = 8  # units of which all arrangements are taken: 40 320
DRAWS, MOST_PLACES = 9_999, 20_000_000  # of all draws together: a cohort of thousands has fewer
TIE = 1e-9  # of the largest sum: two that differ by less are the same in other order of summation

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Permutation:
    """Two-sided p of so many arrangements; `exact`: of all there are, else of seeded draws and the one seen."""

    p: float
    arrangements: int
    exact: bool


def permutation_test(x: Array, scores: Array, *, seed: int) -> Permutation:
    """Test of sum x_i s_i against its arrangements: x (n,), scores (n,), each with its own mean taken off.

    Valid where units are exchangeable if x says nothing of them, whatever their distribution: the p of all n!
    arrangements is uniform on its own values. Beyond 8 units p = (1 + as large) / (1 + draws) (Phipson & Smyth, Stat.
    Appl. Genet. Mol. Biol. 9 (2010) 39).
    """
    orders, exact = _orders(len(x), seed)
    away = x - x.mean()
    sums = np.abs(away[orders] @ (scores - scores.mean()))
    least = sums[0] - TIE * float(sums.max())  # the first arrangement is the one that was seen
    return Permutation(float(np.mean(sums >= least)), len(orders), exact)


@lru_cache(maxsize=4)
def _orders(n: int, seed: int) -> tuple[NDArray[np.intp], bool]:
    """Arrangements (n_arrangements, n) of n places, the one as it is first."""
    if n <= MOST_EXACT:
        return np.array(list(permutations(range(n))), dtype=np.intp), True
    as_it_is = np.arange(n, dtype=np.intp)
    draws = min(DRAWS, MOST_PLACES // n)
    drawn = np.random.default_rng(seed).permuted(np.tile(as_it_is, (draws, 1)), axis=1)
    return np.vstack([as_it_is, drawn]), False
