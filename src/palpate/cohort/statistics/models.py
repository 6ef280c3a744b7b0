"""A patient's modulus from all its scans, and how well scans of one patient repeat: of ln E."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy import stats
from statsmodels.stats.meta_analysis import combine_effects

from palpate.cohort.statistics.scans import Scan, Usable
from palpate.uncertainty.intervals import within_subject_cv


@dataclass(frozen=True, slots=True)
class Combined:
    """A patient's modulus from all its scans and their intervals, `sd` that of its logarithm."""

    value: float
    low95: float
    high95: float
    sd: float


def combined(scans: Sequence[Scan]) -> Combined:
    """Random-effects mean of the scans' ln E with the variances that their intervals state (Paule & Mandel 1982).

    The scans have values.
    """
    logs, variances = np.log([scan.low for scan in scans]), np.array([scan.sd for scan in scans]) ** 2
    mean, sd = float(logs[0]), float(np.sqrt(variances[0]))
    if len(scans) > 1:
        found = combine_effects(logs, variances, method_re="iterated")
        mean, sd = float(found.mean_effect_re), float(found.sd_eff_w_re)
    ends = mean + sd * np.array([-1.0, 1.0]) * stats.norm.ppf(0.975)
    return Combined(float(np.exp(mean)), float(np.exp(ends[0])), float(np.exp(ends[1])), sd)


def repeatability(usable: Usable) -> dict[str, Any]:
    """Within-patient variation and ICC(1) of ln E, from a one-way analysis of variance (Shrout & Fleiss 1979).

    Of the scans with a value. With unequal numbers of scans, n0 = (N - sum n^2 / N) / (k - 1) stands for their number;
    the interval of the ICC, exact for equal ones, is then approximate.
    """
    valued = [scans for patient in usable.patients if (scans := usable.valued(patient))]
    groups = [np.log([scan.low for scan in scans]) for scans in valued]
    counts = np.array([len(group) for group in groups])
    total, k = int(counts.sum()), len(groups)
    if k < 2 or total <= k:
        return {"undefined": "undefined: two patients are needed, and one of them with two scans that have a value"}
    within = sum(float(((group - group.mean()) ** 2).sum()) for group in groups) / (total - k)
    found: dict[str, Any] = {"within_patient_sd_ln": within**0.5, "within_patient_cv": float(within_subject_cv(within))}
    found |= {"n_scans": total, "n_patients": k}
    if within == 0.0:
        return found | {"undefined": "undefined: all scans of each patient have the same modulus"}
    ratio = float(stats.f_oneway(*groups).statistic)
    n0 = (total - float((counts**2).sum()) / total) / (k - 1)
    ends = [ratio / stats.f.ppf(q, k - 1, total - k) for q in (0.975, 0.025)]
    icc, *interval = [float((f - 1.0) / (f - 1.0 + n0)) for f in (ratio, *ends)]
    return found | {"icc": icc, "icc_interval95": interval}
