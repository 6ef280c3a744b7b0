"""Intervals of a modulus: by ellipse or profile, by the mesh beside it, and how it varies from scan to scan."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from palpate.inversion import Bounds, MarginalPosterior, Minimum
from palpate.mesh.space import LagrangeSpace
from palpate.mesh.surface import tissue_surface, triangle_normals
from palpate.uncertainty.profile import Profile, profile

Interval = tuple[float | None, float | None]

NORMAL_95 = 1.959964
AS_ELLIPSE = 0.1  # of the half-width: largest distance of the profile's end for which the ellipse is stated
COEFFICIENT = 0.5
LINEAR = 2.0  # factor on the edge of linear elements, which have half as many points along an edge


@dataclass(frozen=True, slots=True)
class ModulusInterval:
    """95 % interval of a modulus as a ratio to the scale, an open end None; kind: "linearised" or "profile"."""

    ends: Interval
    kind: str
    profile: Profile


def modulus_interval(
    marginal: MarginalPosterior, minimum: Minimum, number: int, *, variance: float, bounds: Bounds
) -> ModulusInterval:
    """That of the log-modulus with a `number` and a `variance`: its ellipse, where the profile ends there, too."""
    centre, half = float(np.exp(minimum.unknowns[number])), NORMAL_95 * float(np.sqrt(variance))
    limits = {"lower": float(np.exp(bounds.lower[number])), "upper": float(np.exp(bounds.upper[number]))}
    ellipse = log_interval(centre, half / NORMAL_95, **limits)
    found = profile(marginal, minimum, number, variance=variance, bounds=bounds, level=NORMAL_95)
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


def discretisation_sd(space: LagrangeSpace, tissues: Sequence[int]) -> float:
    """Standard deviation of ln E, dimensionless, that another mesh of the same edge length would make.

    s = c (h / d)^2 with h = (6 sqrt(2) V / N)^(1/3), the edge of N regular tetrahedra that fill the volume V of the
    `tissues` (by their index in the mesh; several that share a modulus together), twice that for linear elements, and
    d = 6 V / A with the area A of their surfaces: the diameter of a ball, three times the thickness of a plate. The
    order is that of quadratic elements' surfaces; c is measured (`benchmarks/accuracy.py --edges`, docs/method.md).
    """
    mesh = space.mesh
    inside = np.isin(mesh.region, tissues)
    volume = float(mesh.volumes[inside].sum())
    area = sum(
        float(np.linalg.norm(triangle_normals(mesh.nodes, tissue_surface(mesh, t).triangles), axis=1).sum())
        for t in tissues
    )
    edge = (1.0 if space.order > 1 else LINEAR) * (6.0 * np.sqrt(2.0) * volume / np.count_nonzero(inside)) ** (1 / 3)
    return float(COEFFICIENT * (edge * area / (6.0 * volume)) ** 2)


def within_subject_cv(variance: NDArray[np.float64] | float) -> NDArray[np.float64]:
    """Within-subject coefficient of variation of E, of variances (n,) of ln E within subjects, or of one.

    sqrt(exp(s^2) - 1): standard deviation over mean where ln E is normal within a subject (Quan & Shih, Biometrics 52
    (1996) 1195-1203). exp(s) - 1 of Bland & Altman (BMJ 313 (1996) 106) is what one standard deviation adds to E: the
    same for small s, a fifth more at s = 0.5.
    """
    return np.asarray(np.sqrt(np.expm1(variance)))
