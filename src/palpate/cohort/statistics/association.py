"""How modulus and stage go together: correlations with their unit of analysis.

Scans of one patient are not independent: a p-value over scans counts each patient many times. So the patient is the
unit, its modulus the median of its scans, and the interval comes from drawing whole patients (cluster bootstrap;
Davison & Hinkley, Bootstrap Methods and their Application, 1997, section 3.8).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import stats

__all__ = ["Association", "PerPatient", "PerScan", "association", "pearson_p", "points_behind"]

DRAWS = 2000
TAU_DRAWS = 500  # of them, for Kendall's tau, which takes long
MOST_POINTS = 2000
FEWEST = 3  # points of a correlation

Array = NDArray[np.float64]
Interval = tuple[float, float]


@dataclass(frozen=True, slots=True)
class PerScan:
    """Pearson's r with its p, as if all n scans were independent; `interval95`: of r when whole patients are drawn.

    undefined: why there is none, in words; everything else is None then.
    """

    r: float | None
    p: float | None
    n: int
    interval95: Interval | None
    undefined: str = ""


@dataclass(frozen=True, slots=True)
class PerPatient:
    """Pearson's r, Spearman's rho and Kendall's tau-b of the patients' medians, n patients, with intervals.

    Each p takes patients as independent; each interval comes from drawing patients. `undefined` as above.
    """

    r: float | None
    p: float | None
    rho: float | None
    rho_p: float | None
    interval95: Interval | None
    n: int
    tau: float | None = None
    tau_p: float | None = None
    rho_interval95: Interval | None = None
    tau_interval95: Interval | None = None
    undefined: str = ""


@dataclass(frozen=True, slots=True)
class Association:
    """One organ's modulus against the stage, with both units of analysis."""

    per_scan: PerScan
    per_patient: PerPatient


def association(values: Sequence[Array], stages: Array, *, seed: int) -> Association:
    """The association of stages (n_patients,) with moduli, an array (n_scans,) of at least one for each patient."""
    medians = np.array([np.median(part) for part in values])
    scans, of_scans = np.concatenate([np.zeros(0), *values]), np.repeat(stages, [len(part) for part in values])
    words = _undefined(stages, medians, "patient"), _undefined(of_scans, scans, "scan")
    draws = [] if words[0] or words[1] else _draws(stages, medians, seed)

    def interval(of: Callable[[Array, Array], float], most: int = DRAWS) -> Interval | None:
        """Of a statistic of the patients' stages and medians."""
        return _middle([of(stages[d], medians[d]) for d in draws[:most]])

    of_all = [
        _r(np.repeat(stages[d], [len(values[i]) for i in d]), np.concatenate([values[i] for i in d])) for d in draws
    ]
    per_scan = PerScan(None, None, len(scans), None, words[1])
    if not words[1]:
        by_scan = stats.pearsonr(of_scans, scans)
        per_scan = PerScan(float(by_scan.statistic), float(by_scan.pvalue), len(scans), _middle(of_all))
    if words[0]:
        return Association(per_scan, PerPatient(None, None, None, None, None, len(values), undefined=words[0]))
    by_patient, ranked = stats.pearsonr(stages, medians), stats.spearmanr(stages, medians)
    ordered = stats.kendalltau(stages, medians)
    per_patient = PerPatient(
        r=float(by_patient.statistic),
        p=float(by_patient.pvalue),
        rho=float(ranked.statistic),
        rho_p=float(ranked.pvalue),
        interval95=interval(_r),
        n=len(values),
        tau=float(ordered.statistic),
        tau_p=float(ordered.pvalue),
        rho_interval95=interval(lambda x, y: _r(stats.rankdata(x), stats.rankdata(y))),
        tau_interval95=interval(lambda x, y: float(stats.kendalltau(x, y).statistic), TAU_DRAWS),
    )
    return Association(per_scan, per_patient)


def pearson_p(r: float, n: int) -> float:
    """Two-tailed p of Pearson's r between n independent points: t = r sqrt((n - 2) / (1 - r^2)), Student's t."""
    t = abs(r) * np.sqrt((n - 2) / (1.0 - r**2))
    return float(2.0 * stats.t.sf(t, n - 2))


def points_behind(r: float, p: float) -> int:
    """The number n of points at which Pearson's r has the two-tailed p that is nearest to `p` (on a log scale)."""
    counts = range(3, MOST_POINTS)
    return min(counts, key=lambda n: abs(np.log(max(pearson_p(r, n), 1e-300) / p)))


def _undefined(stages: Array, values: Array, unit: str) -> str:
    """Why no correlation can be stated, in words; empty where it can."""
    if len(values) < FEWEST:
        return (
            f"undefined: {len(values)} {unit}{'' if len(values) == 1 else 's'} with a stage and a modulus, and a"
            f" correlation needs {FEWEST}"
        )
    if len(np.unique(stages)) < 2:
        return f"undefined: all {unit}s have the stage {stages[0]:g}, and a correlation needs two"
    return "" if len(np.unique(values)) > 1 else f"undefined: all {unit}s have the same modulus"


def _draws(stages: Array, medians: Array, seed: int) -> list[NDArray[np.int64]]:
    """Draws of whole patients, of which a correlation can be taken."""
    rng = np.random.default_rng(seed)
    draws = rng.integers(len(medians), size=(DRAWS, len(medians)))
    return [d for d in draws if len(np.unique(stages[d])) > 1 and len(np.unique(d)) > 2 and np.ptp(medians[d]) > 0.0]


def _r(x: Array, y: Array) -> float:
    return float(np.corrcoef(x, y)[0, 1])


def _middle(values: Sequence[float]) -> Interval | None:
    if not len(values):
        return None
    low, high = np.percentile(values, [2.5, 97.5])
    return float(low), float(high)
