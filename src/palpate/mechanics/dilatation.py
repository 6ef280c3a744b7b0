"""How an element resists a change of volume: at every point, in the mean, or a blend of both that does not lock.

Near nu = 0.5 the energy lambda/2 (div u)^2 at every quadrature point asks more of a tetrahedron than it has freedom
for: it locks. With the mean of the volume change over each element in its place (mean dilatation; Nagtegaal, Parks &
Rice, CMAME 4 (1974) 153-177) a quadratic tetrahedron does not (it is the P2/P0 mixed element with its pressure
eliminated), but is a little too soft. The blend takes the part lambda_p = lambda c mu / (lambda + c mu) of lambda at
the points, which never exceeds c mu, and the rest in the mean. All three leave the unknowns as they are, the stiffness
positive definite, and for a fixed Poisson's ratio proportional to E.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum

from palpate.errors import ConfigurationError

BLEND = 3.0  # c: for lambda = c mu (nu = 0.375) half of lambda acts at the points; see docs/mechanics.md


class Dilatation(StrEnum):
    """Where the volume change that lambda resists is measured."""

    POINTWISE = "pointwise"
    MEAN = "mean"
    BLENDED = "blended"


@dataclass(frozen=True, slots=True)
class ElementChoice:
    """An element: `space`, the name of its Lagrange space ("P1" or "P2"), and its dilatation."""

    space: str
    dilatation: Dilatation


ELEMENTS = {
    "P1": ElementChoice("P1", Dilatation.POINTWISE),
    "P2": ElementChoice("P2", Dilatation.POINTWISE),
    "P2-P0": ElementChoice("P2", Dilatation.MEAN),
    "auto": ElementChoice("P2", Dilatation.BLENDED),
}


def choose_element(name: str) -> ElementChoice:
    """The element of that name in `case.toml`; raises `ConfigurationError` for another."""
    if name not in ELEMENTS:
        raise ConfigurationError(f"element is '{name}'; it must be one of {sorted(ELEMENTS)}")
    return ELEMENTS[name]


def pointwise_lame(dilatation: Dilatation, lame: float, mu: float) -> float:
    """The part lambda_p of Lame's lambda (`lame`) that acts at the points, in the unit of lambda and mu."""
    if dilatation is Dilatation.BLENDED:
        return lame * BLEND * mu / (lame + BLEND * mu)
    return lame if dilatation is Dilatation.POINTWISE else 0.0


def pointwise_lame_slope(dilatation: Dilatation, lame: float, mu: float, *, by: tuple[float, float]) -> float:
    """Derivative of lambda_p along the derivatives `by` of (lambda, mu)."""
    if dilatation is Dilatation.BLENDED:
        total = lame + BLEND * mu
        return BLEND * (mu**2 * BLEND * by[0] + lame**2 * by[1]) / total**2
    return by[0] if dilatation is Dilatation.POINTWISE else 0.0
