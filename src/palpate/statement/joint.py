"""What is stated of several moduli together: combinations, and joint regions."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass
from itertools import combinations

import numpy as np

from palpate.inversion import Bounds, Inversion
from palpate.parallel import mapped
from palpate.statement.stated_posterior import StatedPosterior
from palpate.uncertainty import (
    Combination,
    joint_region,
    known_pairs,
)

MOST_REGIONS = 3  # of the pairs of moduli that are correlated most


@dataclass(frozen=True, slots=True)
class ModulusRegion:
    """The joint 95 % region of two tissues' moduli (kPa, or ratios): places once around the estimate.

    boundary: by the profile likelihood of both; ellipse: of ln E by their covariance; open: whether the bounds of the
    search cut the boundary.
    """

    tissues: tuple[str, str]
    boundary: tuple[tuple[float, float], ...]
    ellipse: tuple[tuple[float, float], ...]
    open: bool


def combinations_of(
    inversion: Inversion, posterior: StatedPosterior, bounds: Bounds, *, within: float
) -> tuple[Combination, ...]:
    """Ratios (dimensionless) and geometric means (kPa, or ratios) known within a factor."""
    mapping = inversion.objective.parameters
    if not inversion.minimum.converged:
        return ()
    scale = mapping.scale_kpa
    covariance, own = posterior.mixture.covariance.total, (posterior.marginal, posterior.minimum)
    found = known_pairs(*own, mapping.tissues, covariance, bounds=bounds, within=within)
    return tuple(pair.times(scale) if pair.kind == "geometric mean" else pair for pair in found)


def regions_of(
    inversion: Inversion, posterior: StatedPosterior, bounds: Bounds, *, tissues: Collection[str]
) -> tuple[ModulusRegion, ...]:
    """Of the pairs of `tissues` whose moduli are correlated most, `MOST_REGIONS` at the most.

    None is stated of a modulus that is not identified.
    """
    mapping, covariance = inversion.objective.parameters, posterior.mixture.covariance.total
    sd = np.sqrt(np.diag(covariance))
    correlated = -np.abs(covariance / np.outer(sd, sd))
    stated = [i for i, tissue in enumerate(mapping.tissues) if tissue in tissues]
    pairs = sorted(combinations(stated, 2), key=lambda pair: float(correlated[pair]))[:MOST_REGIONS]

    def region(pair: tuple[int, int]) -> ModulusRegion:
        """That of two moduli."""
        own = covariance[np.ix_(pair, pair)]
        found = joint_region(posterior.marginal, posterior.minimum, pair, covariance=own, bounds=bounds)
        edges = mapping.scale_kpa * np.exp(found.boundary), mapping.scale_kpa * np.exp(found.ellipse)
        boundary, ellipse = (tuple((float(a), float(b)) for a, b in edge) for edge in edges)
        return ModulusRegion((mapping.tissues[pair[0]], mapping.tissues[pair[1]]), boundary, ellipse, found.open)

    return tuple(mapped(region, pairs))
