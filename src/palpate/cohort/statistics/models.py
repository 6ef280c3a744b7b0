"""Models of ln E: a mixed model of all scans, a regression of patients weighted by their intervals, repeatability."""

from __future__ import annotations

import warnings
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pandas as pd
import statsmodels.api as sm
import statsmodels.formula.api as smf
from numpy.typing import NDArray
from scipy import optimize, stats
from statsmodels.stats.meta_analysis import combine_effects

from palpate.cohort.statistics.scans import Scan, Usable

__all__ = ["Combined", "combined", "mixed_model", "repeatability", "weighted_regression"]

Array = NDArray[np.float64]
FEWEST = 3


@dataclass(frozen=True, slots=True)
class Combined:
    """A patient's modulus from all its scans and their intervals, `sd` that of its logarithm."""

    value: float
    low95: float
    high95: float
    sd: float


def combined(scans: Sequence[Scan]) -> Combined:
    """Random-effects mean of the scans' ln E with the variances that their intervals state (Paule & Mandel 1982)."""
    logs, variances = np.log([scan.value for scan in scans]), np.array([scan.sd for scan in scans]) ** 2
    mean, sd = float(logs[0]), float(np.sqrt(variances[0]))
    if len(scans) > 1:
        found = combine_effects(logs, variances, method_re="iterated")
        mean, sd = float(found.mean_effect_re), float(found.sd_eff_w_re)
    ends = mean + sd * np.array([-1.0, 1.0]) * stats.norm.ppf(0.975)
    return Combined(float(np.exp(mean)), float(np.exp(ends[0])), float(np.exp(ends[1])), sd)


def mixed_model(usable: Usable, covariates: Mapping[str, Mapping[str, float]]) -> dict[str, Any]:
    """Each scan's ln E by the stage, with a random intercept for each patient (restricted maximum likelihood).

    covariates: name -> id of a row -> number; those that every scan has a number of, and that differ, are fixed effects
    beside the stage.
    """
    scans = [scan for scan in usable.scans if scan.stage is not None]
    patients = [scan.patient for scan in scans]
    words = _undefined_for_models(patients, [scan.stage for scan in scans])
    if not words and max(Counter(patients).values()) == 1:
        words = "undefined: no patient has two scans that count, so scans and patients are the same"
    if words:
        return {"undefined": words}
    frame = pd.DataFrame({"y": np.log([s.value for s in scans]), "stage": [float(s.stage or 0) for s in scans]})
    names: list[str] = []
    for name, numbers in covariates.items():
        column = [numbers.get(scan.id, np.nan) for scan in scans]
        if np.isfinite(column).all() and np.ptp(column) > 0.0:
            frame[f"c{len(names)}"] = column
            names.append(name)
    formula = " + ".join(["y ~ stage", *(f"c{i}" for i in range(len(names)))])
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # what they say is asked of the fit below
        try:
            fit = smf.mixedlm(formula, frame, groups=patients).fit(reml=True)
        except (np.linalg.LinAlgError, ValueError) as error:
            return {"undefined": f"undefined: the mixed model has no solution ({error})"}
        slope, sd = float(fit.params["stage"]), float(fit.bse["stage"])
        between, within = float(fit.cov_re.iloc[0, 0]), float(fit.scale)
    if not fit.converged or not np.isfinite([slope, sd, between, within]).all():
        return {"undefined": "undefined: the mixed model did not converge"}
    found = _per_stage(slope, sd, float(fit.pvalues["stage"]), stats.norm.ppf(0.975))
    remark = "the patients differ by no more than their scans do" if between < 1e-6 * within else ""
    sds = {"sd_between_patients": between**0.5, "sd_within_patients": within**0.5}
    return (
        found | sds | {"n_scans": len(scans), "n_patients": len(set(patients)), "covariates": names, "remark": remark}
    )


def weighted_regression(usable: Usable) -> dict[str, Any]:
    """Each patient's ln E by the stage, weighted by 1 / (sd^2 + tau^2), sd from the intervals of its scans.

    tau, the patients' own scatter about the line, is where the weighted squares have their expected sum n - 2 (Paule &
    Mandel 1982; DerSimonian & Kacker 2007, doi 10.1016/j.cct.2006.04.004).
    """
    patients = [patient for patient in usable.patients if usable.stage_of(patient) is not None]
    stages = np.array([float(usable.stage_of(patient) or 0) for patient in patients])
    words = _undefined_for_models(patients, stages.tolist())
    if words:
        return {"undefined": words}
    means = [combined(usable.of(patient)) for patient in patients]
    logs, variances = np.log([mean.value for mean in means]), np.array([mean.sd for mean in means]) ** 2
    design = sm.add_constant(stages)

    def excess(tau2: float) -> float:
        """Weighted sum of squares above its expectation."""
        weights = 1.0 / (variances + tau2)
        residuals = sm.WLS(logs, design, weights=weights).fit().resid
        return float(weights @ residuals**2) - (len(patients) - 2)

    most = 10.0 * float(np.var(logs)) + 1.0
    tau2 = float(optimize.brentq(excess, 0.0, most)) if excess(0.0) > 0.0 > excess(most) else 0.0
    fit = sm.WLS(logs, design, weights=1.0 / (variances + tau2)).fit(cov_type="fixed scale")
    degrees = len(patients) - 2
    slope, sd = float(fit.params[1]), float(fit.bse[1])
    p = float(2.0 * stats.t.sf(abs(slope) / sd, degrees))
    middle = float(stages.mean())
    place = {"mean_stage": middle, "at_mean_stage": float(np.exp(fit.params[0] + slope * middle))}
    found = _per_stage(slope, sd, p, stats.t.ppf(0.975, degrees)) | place
    return found | {"n_patients": len(patients), "tau": tau2**0.5}


def repeatability(usable: Usable) -> dict[str, Any]:
    """Within-patient variation and ICC(1) of ln E, from a one-way analysis of variance (Shrout & Fleiss 1979).

    With unequal numbers of scans, n0 = (N - sum n^2 / N) / (k - 1) stands for their number; the interval of the ICC,
    exact for equal ones, is then approximate.
    """
    groups = [np.log([scan.value for scan in usable.of(patient)]) for patient in usable.patients]
    counts = np.array([len(group) for group in groups])
    total, k = int(counts.sum()), len(groups)
    if k < 2 or total <= k:
        return {"undefined": "undefined: two patients are needed, and one of them with two scans that count"}
    within = sum(float(((group - group.mean()) ** 2).sum()) for group in groups) / (total - k)
    found: dict[str, Any] = {"within_patient_sd_ln": within**0.5, "within_patient_cv": float(np.expm1(within)) ** 0.5}
    found |= {"n_scans": total, "n_patients": k}
    if within == 0.0:
        return found | {"undefined": "undefined: all scans of each patient have the same modulus"}
    ratio = float(stats.f_oneway(*groups).statistic)
    n0 = (total - float((counts**2).sum()) / total) / (k - 1)
    ends = [ratio / stats.f.ppf(q, k - 1, total - k) for q in (0.975, 0.025)]
    icc, *interval = [float((f - 1.0) / (f - 1.0 + n0)) for f in (ratio, *ends)]
    return found | {"icc": icc, "icc_interval95": interval}


def _per_stage(slope: float, sd: float, p: float, half_width: float) -> dict[str, Any]:
    """By which factor E grows with each stage."""
    ends = np.exp([slope - half_width * sd, slope + half_width * sd])
    return {"factor_per_stage": float(np.exp(slope)), "interval95": [float(end) for end in ends], "p": p}


def _undefined_for_models(patients: Sequence[str], stages: Sequence[float | None]) -> str:
    if len(set(patients)) < FEWEST:
        return f"undefined: {len(set(patients))} patients with a stage and a modulus, and {FEWEST} are needed"
    return "" if len(set(stages)) > 1 else "undefined: all patients have the same stage"
