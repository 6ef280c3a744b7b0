"""The 95 % interval of a modulus: the ellipse where that is true, else where the profile likelihood ends."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from palpate.inversion import Bounds, LeastSquares, Minimum
from palpate.uncertainty.profile import Profile, profile

__all__ = ["NORMAL_95", "Interval", "ModulusInterval", "log_interval", "modulus_interval"]

Interval = tuple[float | None, float | None]

NORMAL_95 = 1.959964
AS_ELLIPSE = 0.1  # of the half-width: an end of the profile that is no further from the ellipse's says the same


@dataclass(frozen=True, slots=True)
class ModulusInterval:
    """95 % interval of a modulus as a ratio to the scale, an open end None; kind: "linearised" or "profile"."""

    ends: Interval
    kind: str
    profile: Profile


def modulus_interval(
    fixed: LeastSquares, minimum: Minimum, number: int, *, variance: float, bounds: Bounds
) -> ModulusInterval:
    """That of the log-modulus with a `number` and a `variance`: its ellipse, where the profile ends there, too."""
    centre, half = float(np.exp(minimum.unknowns[number])), NORMAL_95 * float(np.sqrt(variance))
    limits = {"lower": float(np.exp(bounds.lower[number])), "upper": float(np.exp(bounds.upper[number]))}
    ellipse = log_interval(centre, half / NORMAL_95, **limits)
    found = profile(fixed, minimum, number, variance=variance, bounds=bounds, level=NORMAL_95)
    low, high = (None if end is None else float(np.exp(end)) for end in (found.low, found.high))
    same = all(
        (a is None and b is None) or (a is not None and b is not None and abs(np.log(a / b)) < AS_ELLIPSE * half)
        for a, b in zip(ellipse, (low, high), strict=True)
    )
    return ModulusInterval(ellipse, "linearised", found) if same else ModulusInterval((low, high), "profile", found)


def log_interval(centre: float, sd: float, *, lower: float, upper: float) -> Interval:
    """95 % interval exp(ln centre +- 1.96 sd); an end beyond the bounds (lower, upper), in `centre`'s unit, is open."""
    low, high = centre * np.exp(-NORMAL_95 * sd), centre * np.exp(NORMAL_95 * sd)
    return (float(low) if low > lower else None, float(high) if high < upper else None)
