"""Intervals and verdicts: what is stated of each modulus."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from palpate.body.poisson_ratios import NOT_IDENTIFIED, not_converged
from palpate.inversion import Inversion, InversionSettings
from palpate.statement.estimation import ModulusEstimate, no_estimate
from palpate.statement.stated_posterior import StatedPosterior
from palpate.uncertainty import (
    NORMAL_95,
    Covariance,
    Interval,
    Marginal,
    ModulusInterval,
    log_interval,
    marginals_of,
)
from palpate.unknowns import KNOWN_MODULUS

IDENTIFIED, WEAK = 4.0, 10.0  # largest ratio of an interval's ends: a factor of 2 to each side, and of 3.2
NOT_FOLLOWED = "the 95 % interval is open: it could not be computed from a minimum"


def verdict(interval: Interval, *, at_bound: bool, absolute: bool) -> tuple[str, str]:
    """Verdict and its reason from the interval of a modulus or ratio.

    `identified`: closed and high/low <= 4, a factor of 2 to each side; `weak`: closed and wider; `not identified`: an
    open end, a bound, or high/low > 10; `ratio only`: identified or weak, but no known modulus holds the scale.
    """
    low, high = interval
    if at_bound:
        return NOT_IDENTIFIED, "the estimate lies at its bound; the data do not limit it"
    if low is None or high is None:
        return NOT_IDENTIFIED, "the 95 % interval is open: it reaches beyond the bounds of the search"
    width = high / low
    if width > WEAK:
        return NOT_IDENTIFIED, f"the 95 % interval spans a factor {width:.1f}"
    if not absolute:
        return "ratio only", f"no modulus is known, so only the ratio is determined (within a factor {width:.2f})"
    if width <= IDENTIFIED:
        return "identified", f"the 95 % interval spans a factor {width:.2f}"
    return "weak", f"the 95 % interval spans a factor {width:.2f}; more image pairs or a larger motion narrow it"


@dataclass(frozen=True, slots=True)
class Known:
    """Of one parameter: its median, its interval as e^theta, whether the likeliest explanation lies at a bound.

    own: the interval of the likeliest explanation alone, with its profile; followed: whether that could be followed.
    """

    theta: float
    marginal: Marginal
    own: ModulusInterval
    interval: Interval
    at_bound: bool
    followed: bool


def intervals_of(inversion: Inversion, settings: InversionSettings, posterior: StatedPosterior) -> tuple[Known, ...]:
    """Of each parameter its quantiles over all explanations; none where nothing converged."""
    if not inversion.minimum.converged:
        return ()
    bounds = settings.bounds
    at_bound = bounds.reached(posterior.minimum.unknowns[: inversion.objective.n_parameters])
    every = posterior.intervals
    marginals, found = marginals_of(posterior.mixture, every), list[Known]()
    for i, (own, marginal) in enumerate(zip(every, marginals, strict=True)):
        ends = float(bounds.lower[i]), float(bounds.upper[i])
        middle = marginal.quantile(0.5, ends)
        theta = float(inversion.mixture.mean[i]) if middle is None else middle
        followed = len(own.profile.theta) > 1
        interval = marginal.interval(ends) if followed else (None, None)
        found.append(Known(theta, marginal, own, interval, bool(at_bound[i]), followed))
    return tuple(found)


def estimates_of(
    inversion: Inversion,
    known: Sequence[Known],
    covariance: Covariance,
    *,
    truth: Mapping[str, float],
) -> tuple[ModulusEstimate, ...]:
    """The estimates of moduli whose intervals are `known`, their values medians.

    truth: true moduli (kPa) by tissue, where known.
    """
    mapping, scale = inversion.objective.parameters, inversion.objective.parameters.scale_kpa
    none = [
        no_estimate(
            name,
            absolute=mapping.absolute,
            relative_to=mapping.relative_to,
            why=not_converged(inversion),
            truth=truth.get(name),
        )
        for name in mapping.tissues
    ]
    if not known:
        return tuple(none)
    found, unit = [], scale if mapping.absolute else 1.0
    given = np.diag(covariance.total if covariance.given_model is None else covariance.given_model)
    shift = mapping.reference_shift(inversion.minimum.unknowns)
    for i, (nothing, of) in enumerate(zip(none, known, strict=False)):
        theta, (low, high) = of.theta, of.interval
        value, shares = float(np.exp(theta)), covariance.shares(i)
        of_scale = float(np.sqrt(shares.get(KNOWN_MODULUS, 0.0) * covariance.total[i, i]))
        by_ratio = without_scale(of_scale, of.interval, value, centre=float(np.exp(theta - shift)))
        word, why = verdict(of.interval, at_bound=of.at_bound, absolute=mapping.absolute)
        why = why if of.followed or of.at_bound else NOT_FOLLOWED
        if of_scale > 0.0:
            word, why = or_as_ratio((word, why), by_ratio, at_bound=of.at_bound)
        points = zip(unit * np.exp(of.own.profile.theta), of.own.profile.root, strict=True)
        inside = log_interval(value, float(np.sqrt(given[i])), lower=low or 0.0, upper=high or np.inf)
        within = (inside[0] or low, inside[1] or high)
        found.append(
            replace(
                nothing,
                interval_kind=of.own.kind,
                interval95_given_model=_stated(within, word, unit),
                variance_shares=shares,
                profile=tuple((float(at), float(root)) for at, root in points),
                value=value * scale if mapping.absolute else None,
                interval95=_stated(of.interval, word, scale) if mapping.absolute else None,
                ratio=None if mapping.by_load else float(np.exp(theta - shift)),
                ratio_interval95=None if mapping.by_load else _stated(by_ratio, word),
                verdict=word,
                why=why,
            )
        )
    return tuple(found)


def or_as_ratio(found: tuple[str, str], by_ratio: Interval, *, at_bound: bool) -> tuple[str, str]:
    """Verdict and reason of a modulus whose scale is known only within a range: its ratio may say more.

    found: those of the modulus in kPa, which stay where its ratio says no more.
    """
    ratio_word, ratio_why = verdict(by_ratio, at_bound=at_bound, absolute=True)
    if found[0] == "identified" or ratio_word in (NOT_IDENTIFIED, found[0]):
        return found
    return "ratio only", f"of the ratio {ratio_why}; the range of the known modulus makes the interval in kPa wider"


def without_scale(sd: float, interval: Interval, value: float, *, centre: float) -> Interval:
    """An interval about another centre, with the half-widths in ln reduced by an independent cause.

    sd: that of the cause, in ln; h -> sqrt(h^2 - (1.96 sd)^2).
    """
    halves = [None if end is None else abs(np.log(end / value)) for end in interval]
    low, high = (None if h is None else float(np.sqrt(max(h**2 - (NORMAL_95 * sd) ** 2, 0.0))) for h in halves)
    return (
        None if low is None else float(centre * np.exp(-low)),
        None if high is None else float(centre * np.exp(high)),
    )


def _stated(interval: Interval, word: str, unit: float = 1.0) -> Interval | None:
    """The interval times a unit; none for a modulus that is not identified."""
    low, high = interval
    return None if word == NOT_IDENTIFIED else (low and low * unit, high and high * unit)
