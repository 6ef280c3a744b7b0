"""Stiffness by stage: a regression of ln E in which a scan without a value counts by its interval."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import optimize, special, stats

from palpate.cohort.statistics.association import Permutation, permutation_test
from palpate.cohort.statistics.scans import Scan

FEWEST = 3  # patients, and scans with a value
LEVEL = 0.05
LEAST_BETWEEN, LEAST_WITHIN, LARGEST = 0.01, 0.05, 3.0  # standard deviations of ln E
STEEPEST = 10.0  # change of ln E over all stages: beyond it an end is open
PLACES = np.linspace(-5.0, 5.0, 81)  # of a patient's own modulus, in standard deviations
WEIGHTS = stats.norm.logpdf(PLACES) + np.log(PLACES[1] - PLACES[0])
BISECTIONS = 8

Array = NDArray[np.float64]


def stage_regression(
    scans: Sequence[Scan], *, covariates: Mapping[str, Mapping[str, float]] | None = None, seed: int = 0
) -> dict[str, Any]:
    """By which factor E grows with each stage, of patients with one stage, with its 95 % interval and a p.

    ln E of scan j of patient i is a + b stage_i + u_i + w_ij, u ~ N(0, tau^2), w ~ N(0, omega^2). A scan with a value
    adds the variance that its interval states; a censored one contributes the probability of lying in its interval. p:
    permutation of the stages against the patients' scores d ln L_i / du where b = 0, which is exact whatever the
    scatter (Fay & Shaw, J. Stat. Softw. 36 (2010) 2, for censored data). interval95: the slopes that this test, with
    the slope taken off, does not reject; None at an open end, where no slope is rejected or data end.
    covariates: name -> id of a row -> number; those that all scans have, and that differ, stand beside the stage, by
    their mean of each patient. With any, permutation is approximate, and no p is given.
    """
    stages: dict[str, set[int | None]] = {}
    for scan in scans:
        stages.setdefault(scan.patient, set()).add(scan.stage)
    one = sorted(patient for patient, of in stages.items() if len(of) == 1 and None not in of)
    kept = sorted((scan for scan in scans if scan.patient in one), key=lambda scan: (scan.patient, scan.id))
    x = np.array([float(next(iter(stages[patient])) or 0) for patient in one])
    beside = dict[str, Array]()
    for name, of_scans in (covariates or {}).items():
        found_of = [[of_scans.get(scan.id, np.nan) for scan in kept if scan.patient == patient] for patient in one]
        means = np.array([np.mean(numbers) for numbers in found_of])
        if np.isfinite(means).all() and len(means) and np.ptp(means) > 0.0:
            beside[name] = means
    values, needed = {scan.value for scan in kept if scan.value is not None}, max(FEWEST, 3 + len(beside))
    words = "" if len(values) >= FEWEST else f"{len(values)} different values, and {FEWEST} are needed"
    if len(x) < needed:
        words = f"{len(x)} patients with a stage and a modulus, and {needed} are needed"
    elif len(np.unique(x)) < 2:
        words = f"all patients have the stage {x[0]:g}, and a regression needs two"
    if words:
        return {"undefined": f"undefined: {words}"}
    regression = _Regression(
        PatientScans.of(kept, one), x - x.mean(), np.array([np.ones(len(x)), *beside.values()]).T, seed
    )
    slope, fitted = regression.slope()
    found: dict[str, Any] = {
        "factor_per_stage": None if abs(slope) > 0.999 * regression.steepest else float(np.exp(slope)),
        "interval95": [None if end is None else float(np.exp(end)) for end in regression.interval(slope)],
    }
    if not beside:
        found |= asdict(regression.test(0.0))
    several = len(kept) > len(one)
    return found | {
        "n_patients": len(one),
        "n_scans": len(kept),
        "n_censored": sum(scan.value is None for scan in kept),
        "sd_between_patients": fitted.between if several else None,
        "sd_within_patients": fitted.within if several else None,
        "mean_stage": float(x.mean()),
        "at_mean_stage": float(np.exp(fitted.mean.mean())),
        "covariates": list(beside),
    }


@dataclass(frozen=True, slots=True)
class _Fit:
    """Mean of each patient's ln E (n,), and the standard deviations between patients and of their scans."""

    mean: Array
    between: float
    within: float

    @classmethod
    def of(cls, at: Array, columns: Array, offset: Array | float = 0.0) -> _Fit:
        """Of unknowns (k + 2,), coefficients and logarithms of standard deviations, with columns (n, k)."""
        between, within = np.exp(at[-2:])
        return cls(offset + columns @ at[:-2], float(between), float(within))


@dataclass(frozen=True, slots=True)
class LogLikelihood:
    """Of each patient (n,), with its derivatives by the mean (n,) and by ln `between` and ln `within` (2, n)."""

    values: Array
    by_mean: Array
    by_sd: Array


@dataclass(frozen=True, slots=True)
class PatientScans:
    """Scans of n patients, by ln E (kPa, or of a ratio).

    y (n_values,): those with a value, their variances (n_values,) and whose they are, of_value (n_values,); lows, highs
    (n_censored,): ends of the others, and whose these are, of_censored (n_censored,).
    """

    n: int
    y: Array
    variances: Array
    of_value: NDArray[np.intp]
    lows: Array
    highs: Array
    of_censored: NDArray[np.intp]

    @classmethod
    def of(cls, scans: Sequence[Scan], patients: Sequence[str]) -> PatientScans:
        """Of scans whose patients are all among these."""
        number = {patient: i for i, patient in enumerate(patients)}
        valued = [scan for scan in scans if scan.value is not None]
        censored = [scan for scan in scans if scan.value is None]
        with np.errstate(divide="ignore"):
            lows, highs = (np.log([getattr(scan, end) for scan in censored]) for end in ("low", "high"))
        return cls(
            len(patients),
            np.log([scan.low for scan in valued]),
            np.array([scan.sd**2 for scan in valued]),
            np.array([number[scan.patient] for scan in valued], dtype=np.intp),
            lows,
            highs,
            np.array([number[scan.patient] for scan in censored], dtype=np.intp),
        )

    @property
    def middles(self) -> Array:
        """A guess of each patient's ln E, (n,): the mean of its scans, of censored ones a finite end."""
        ends = np.where(np.isfinite(self.lows), self.lows, self.highs)
        patients = np.concatenate([self.of_value, self.of_censored])
        sums = np.bincount(patients, np.concatenate([self.y, ends]), self.n)
        return np.asarray(sums / np.bincount(patients, minlength=self.n))

    def log_likelihood(self, mean: Array, between: float, within: float) -> LogLikelihood:
        """Of each patient, whose own ln E lies about `mean` (n,) with the standard deviation `between`.

        Values are integrated over the patient's own modulus in closed form; the probabilities of censored scans over
        what the values leave of it, by the trapezoidal rule.
        """
        of_patients, of_scans = between**2, within**2  # variances

        def sums(of_values: Array) -> Array:
            """Of each patient (n,)."""
            return np.asarray(np.bincount(self.of_value, of_values, self.n), dtype=np.float64)

        weights = 1.0 / (self.variances + of_scans)
        slopes = -2.0 * of_scans * weights**2  # of the weights by ln within
        precision, by_within = sums(weights), sums(slopes)
        some = np.maximum(precision, 1e-300)
        own = sums(weights * self.y) / some
        own_by_within = (sums(slopes * self.y) - own * by_within) / some
        squares = (self.y - own[self.of_value]) ** 2
        shrunk, apart = 1.0 + precision * of_patients, own - mean
        grows, kept = np.stack([2.0 * precision * of_patients, by_within * of_patients]), precision / shrunk
        found = 0.5 * (sums(np.log(weights / (2.0 * np.pi)) - weights * squares) - np.log(shrunk) - apart**2 * kept)
        by_sd = -0.5 * grows / shrunk * (1.0 - apart**2 * kept)
        by_sd[1] += 0.5 * sums(slopes / weights - slopes * squares)
        by_sd[1] -= apart * own_by_within * kept + 0.5 * apart**2 * by_within / shrunk
        if not len(self.of_censored):
            return LogLikelihood(found, apart * kept, by_sd)
        centre, spread = (mean + of_patients * precision * own) / shrunk, between / np.sqrt(shrunk)
        drawn = np.stack(
            [2.0 * of_patients * precision * own, of_patients * (by_within * own + precision * own_by_within)]
        )
        centres, spreads = (drawn - centre * grows) / shrunk, -0.5 * spread * grows / shrunk
        spreads[0] += spread
        held, of_held = np.unique(self.of_censored, return_inverse=True)
        member = np.asarray(of_held == np.arange(len(held))[:, None], dtype=np.float64)
        at = (centre[held, None] + spread[held, None] * PLACES)[of_held]
        # logarithm of the standard normal probability of (low, high), without loss in either tail
        low, high = (self.lows[:, None] - at) / within, (self.highs[:, None] - at) / within
        below, above = np.where(low > 0.0, -high, low), np.where(low > 0.0, -low, high)
        largest = special.log_ndtr(above)
        chances = largest + np.log1p(-np.exp(np.minimum(special.log_ndtr(below) - largest, -1e-12)))
        densities = [np.exp(-0.5 * end**2 - 0.5 * np.log(2.0 * np.pi) - chances) for end in (low, high)]
        ends = [np.where(np.isfinite(end), end, 0.0) for end in (low, high)]
        inside = WEIGHTS + member @ chances
        likely = special.logsumexp(inside, axis=1)
        shares = np.exp(inside - likely[:, None])
        by_place = shares * (member @ (densities[0] - densities[1])) / within
        by_centre, by_spread = by_place.sum(axis=1), by_place @ PLACES
        found[held] += likely
        by_mean = apart * kept
        by_mean[held] += by_centre / shrunk[held]
        by_sd[:, held] += by_centre * centres[:, held] + by_spread * spreads[:, held]
        by_sd[1, held] += (shares * (member @ (ends[0] * densities[0] - ends[1] * densities[1]))).sum(axis=1)
        return LogLikelihood(found, by_mean, by_sd)


@dataclass(frozen=True, slots=True)
class _Regression:
    """The regression of `data` on x (n,), without its mean, beside columns (n, k), the first of ones."""

    data: PatientScans
    x: Array
    columns: Array
    seed: int

    @property
    def steepest(self) -> float:
        """The largest slope that is looked at."""
        return STEEPEST / float(np.ptp(self.x))

    def slope(self) -> tuple[float, _Fit]:
        """The most likely slope, and the fit with it."""
        columns = np.column_stack([self.columns, self.x])
        at = self._fit(columns, np.zeros(len(self.x)))
        return float(at[-3]), _Fit.of(at, columns)

    def test(self, slope: float, near: Array | None = None) -> Permutation:
        """The test of that slope: of the stages against the scores of the fit without them, the slope taken off.

        near: unknowns of a fit that is not far from it.
        """
        fit = _Fit.of(self._fit(self.columns, slope * self.x, near), self.columns, slope * self.x)
        scores = self.data.log_likelihood(fit.mean, fit.between, fit.within).by_mean
        alone = self.x - self.columns @ np.linalg.lstsq(self.columns, self.x)[0]
        return permutation_test(alone, scores, seed=self.seed)

    def interval(self, slope: float) -> tuple[float | None, float | None]:
        """The slopes around the most likely one that the test does not reject at 5 %."""
        width = float(np.std(self.data.middles)) / float(np.linalg.norm(self.x)) + 1e-3
        near = self._fit(self.columns, slope * self.x)
        low, high = (self._end(slope, sign * width, near) for sign in (-1.0, 1.0))
        return low, high

    def _end(self, slope: float, step: float, near: Array) -> float | None:
        """Where the test begins to reject, from the most likely slope on; None where it never does."""
        inside, outside = slope, slope + step
        while self.test(outside, near).p >= LEVEL:
            if abs(outside) >= self.steepest:
                return None
            inside, step = outside, 2.0 * step
            outside = float(np.clip(outside + step, -self.steepest, self.steepest))
        for _ in range(BISECTIONS):
            middle = 0.5 * (inside + outside)
            inside, outside = (middle, outside) if self.test(middle, near).p >= LEVEL else (inside, middle)
        return outside

    def _fit(self, columns: Array, offset: Array, near: Array | None = None) -> Array:
        """The most likely unknowns (k + 2,) of columns (n, k) beside an offset (n,), sought from those of a fit `near`.

        They are coefficients and the logarithms of both standard deviations. Where no patient has two scans, their own
        scatter cannot be told from that of patients, and is held.
        """
        data, k = self.data, columns.shape[1]
        first = np.linalg.lstsq(columns, data.middles - offset)[0]
        scatter = float(np.clip(np.std(data.middles - offset - columns @ first), 2.0 * LEAST_WITHIN, 1.0))

        def negative(at: Array) -> tuple[float, Array]:
            """Minus the log-likelihood of coefficients and logarithms of standard deviations, with its gradient."""
            there = data.log_likelihood(offset + columns @ at[:k], *np.exp(at[k:]))
            return -float(there.values.sum()), -np.concatenate([there.by_mean @ columns, there.by_sd.sum(axis=1)])

        single = len(data.y) + len(data.lows) == data.n
        held = np.log([LEAST_WITHIN, LEAST_WITHIN if single else LARGEST])
        bounds: list[tuple[float | None, float | None]] = [(None, None)] * k
        bounds += [(np.log(LEAST_BETWEEN), np.log(LARGEST)), (held[0], held[1])]
        if k > self.columns.shape[1]:
            bounds[k - 1] = (-self.steepest, self.steepest)
        start = np.array([*first, np.log(scatter), np.log(LEAST_WITHIN if single else scatter)])
        begin = start if near is None else near
        return np.asarray(optimize.minimize(negative, begin, jac=True, bounds=bounds, method="L-BFGS-B").x)
