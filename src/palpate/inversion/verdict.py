"""Intervals and verdicts in words."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from palpate.inversion.estimation import Interval

__all__ = ["NORMAL_95", "hull", "log_interval", "verdict"]

NORMAL_95 = 1.959964
IDENTIFIED, WEAK = 2.0, 10.0  # largest ratio of an interval's ends


def log_interval(centre: float, sd: float, *, lower: float, upper: float) -> Interval:
    """95 % interval exp(ln centre +- 1.96 sd); an end beyond the bounds (lower, upper), in `centre`'s unit, is open."""
    low, high = centre * np.exp(-NORMAL_95 * sd), centre * np.exp(NORMAL_95 * sd)
    return (float(low) if low > lower else None, float(high) if high < upper else None)


def hull(intervals: Sequence[Interval]) -> Interval:
    """Smallest interval that holds all of one or more; an end that is open in one of them is open."""
    lows, highs = [low for low, _ in intervals], [high for _, high in intervals]
    low = None if None in lows else min(end for end in lows if end is not None)
    high = None if None in highs else max(end for end in highs if end is not None)
    return low, high


def verdict(interval: Interval, *, at_bound: bool, absolute: bool) -> tuple[str, str]:
    """Verdict and its reason from the interval of a modulus or ratio.

    `identified`: closed and high/low <= 2; `weak`: closed and wider; `not identified`: an open end, a bound, or
    high/low > 10; `ratio only`: identified or weak, but no known modulus holds the scale.
    """
    low, high = interval
    if at_bound:
        return "not identified", "the estimate lies at its bound; the images do not hold it back"
    if low is None or high is None:
        return "not identified", "the 95 % interval is open: it reaches beyond the bounds of the search"
    width = high / low
    if width > WEAK:
        return "not identified", f"the 95 % interval spans a factor {width:.1f}"
    if not absolute:
        return "ratio only", f"no modulus is known, so only the ratio is determined (within a factor {width:.2f})"
    if width <= IDENTIFIED:
        return "identified", f"the 95 % interval spans a factor {width:.2f}"
    return "weak", f"the 95 % interval spans a factor {width:.2f}; more image pairs or a larger motion narrow it"
