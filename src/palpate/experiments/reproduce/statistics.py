"""How modulus and stage go together: correlations with their unit of analysis.

Scans of one patient are not independent: a p-value over scans counts each patient many times. So the patient is the
unit, its modulus the median of its scans, and the interval comes from drawing whole patients (cluster bootstrap;
Davison & Hinkley, Bootstrap Methods and their Application, 1997, section 3.8).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import stats

__all__ = ["Association", "PerPatient", "PerScan", "association", "pearson_p", "points_behind"]

DRAWS = 2000
MOST_POINTS = 2000

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class PerScan:
    """Pearson's r with its p, as if all n scans were independent; `interval95`: of r when whole patients are drawn."""

    r: float
    p: float
    n: int
    interval95: tuple[float, float]


@dataclass(frozen=True, slots=True)
class PerPatient:
    """Pearson's r and Spearman's rho of the patients' medians, n patients, r's interval from drawing patients."""

    r: float
    p: float
    rho: float
    rho_p: float
    interval95: tuple[float, float]
    n: int


@dataclass(frozen=True, slots=True)
class Association:
    """One organ's modulus against the stage, with both units of analysis."""

    per_scan: PerScan
    per_patient: PerPatient


def association(values: list[Array], stages: Array, *, seed: int) -> Association:
    """The association of stages (n_patients,) with moduli (kPa), an array (n_scans,) for each patient."""
    rng = np.random.default_rng(seed)
    medians = np.array([np.median(part) for part in values])
    scans, of_scans = np.concatenate(values), np.repeat(stages, [len(part) for part in values])
    by_scan, by_patient = stats.pearsonr(of_scans, scans), stats.pearsonr(stages, medians)
    ranked = stats.spearmanr(stages, medians)
    draws = rng.integers(len(values), size=(DRAWS, len(values)))
    drawn = [d for d in draws if len(np.unique(stages[d])) > 1 and len(np.unique(d)) > 2]
    of_patients = [_r(stages[d], medians[d]) for d in drawn]
    of_all = [
        _r(np.repeat(stages[d], [len(values[i]) for i in d]), np.concatenate([values[i] for i in d])) for d in drawn
    ]
    return Association(
        PerScan(float(by_scan.statistic), float(by_scan.pvalue), len(scans), _middle(of_all)),
        PerPatient(
            float(by_patient.statistic),
            float(by_patient.pvalue),
            float(ranked.statistic),
            float(ranked.pvalue),
            _middle(of_patients),
            len(values),
        ),
    )


def pearson_p(r: float, n: int) -> float:
    """Two-tailed p of Pearson's r between n independent points: t = r sqrt((n - 2) / (1 - r^2)), Student's t."""
    t = abs(r) * np.sqrt((n - 2) / (1.0 - r**2))
    return float(2.0 * stats.t.sf(t, n - 2))


def points_behind(r: float, p: float) -> int:
    """The number n of points at which Pearson's r has the two-tailed p that is nearest to `p` (on a log scale)."""
    counts = range(3, MOST_POINTS)
    return min(counts, key=lambda n: abs(np.log(max(pearson_p(r, n), 1e-300) / p)))


def _r(x: Array, y: Array) -> float:
    return float(np.corrcoef(x, y)[0, 1])


def _middle(values: list[float]) -> tuple[float, float]:
    low, high = np.percentile(values, [2.5, 97.5])
    return float(low), float(high)
