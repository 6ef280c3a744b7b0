"""How modulus and stage go together: correlations of patients, and of scans beside them, described and not tested.

Scans of one patient are not independent: what is said over scans counts each patient many times. So the patient is the
unit, its modulus the median of its scans. The test of a cohort is that of its regression, which takes each scan with
its interval.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from itertools import permutations

import numpy as np
from numpy.typing import NDArray
from scipy import stats

FEWEST = 3  # points of a correlation

Array = NDArray[np.float64]
MOST_EXACT = 8  # units of which all arrangements are taken: 40 320
DRAWS, MOST_PLACES = 9_999, 20_000_000  # of all draws together: a cohort of thousands has fewer
TIE = 1e-9  # of the largest sum: two that differ by less are the same in other order of summation


@dataclass(frozen=True, slots=True)
class PerScan:
    """Pearson's r of n scans as if they were independent; `undefined`: why there is none, in words."""

    r: float | None
    n: int
    undefined: str = ""


@dataclass(frozen=True, slots=True)
class PerPatient:
    """Pearson's r, Spearman's rho and Kendall's tau-b of n patients' medians; `undefined`: why there are none.

    Where medians are known by an interval only (`n_censored`), there is tau alone: r and rho would leave them out.
    """

    r: float | None
    rho: float | None
    tau: float | None
    n: int
    n_censored: int = 0
    undefined: str = ""


@dataclass(frozen=True, slots=True)
class Association:
    """One organ's modulus against the stage, with both units of analysis."""

    per_scan: PerScan
    per_patient: PerPatient


def association(lows: Sequence[Array], highs: Sequence[Array], stages: Array) -> Association:
    """The association of stages (n_patients,) with moduli, given by their ends: two arrays (n_scans,) a patient.

    Both ends are the value where it is known; 0 and infinity are open. A median's ends are the medians of the ends.
    """
    below, above = (np.array([np.median(part) for part in ends]) for ends in (lows, highs))
    scans = np.concatenate([np.zeros(0), *lows])
    of_scans = np.repeat(stages, [len(part) for part in lows])
    open_scans = int((scans != np.concatenate([np.zeros(0), *highs])).sum())
    words = f"undefined: {open_scans} scans are known by an interval only" if open_scans else ""
    words = words or _undefined(of_scans, len(np.unique(scans)) < 2, "scan")
    per_scan = PerScan(None if words else _r(of_scans, scans), len(scans), words)
    n, open_medians = len(stages), int((below != above).sum())
    words = _undefined(stages, not _signs(below, above).any(), "patient")
    if words:
        return Association(per_scan, PerPatient(None, None, None, n, open_medians, words))
    signs, order = _signs(below, above), _signs(stages, stages)
    tau = float((signs * order).sum() / np.sqrt(float((signs**2).sum()) * float((order**2).sum())))
    if open_medians:
        return Association(per_scan, PerPatient(None, None, tau, n, open_medians))
    rho = _r(stats.rankdata(stages), stats.rankdata(below))
    return Association(per_scan, PerPatient(_r(stages, below), rho, tau, n))


def _signs(below: Array, above: Array) -> Array:
    """Of each pair (n, n): 1 where the first is larger, -1 where it is smaller, 0 where the ends do not tell.

    So Kendall's tau-b takes pairs that censoring leaves open as ties (Brown, Hollander & Korwar 1974).
    """
    larger = below[:, None] > above[None, :]
    return larger.astype(float) - larger.T


def _undefined(stages: Array, same: bool, unit: str) -> str:
    """Why no correlation can be stated, in words; empty where it can. `same`: all values are, or nobody can tell."""
    if len(stages) < FEWEST:
        return (
            f"undefined: {len(stages)} {unit}{'' if len(stages) == 1 else 's'} with a stage and a modulus, and a"
            f" correlation needs {FEWEST}"
        )
    if len(np.unique(stages)) < 2:
        return f"undefined: all {unit}s have the stage {stages[0]:g}, and a correlation needs two"
    return f"undefined: no two {unit}s have moduli that can be told apart" if same else ""


def _r(x: Array, y: Array) -> float:
    return float(np.corrcoef(x, y)[0, 1])


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
