"""What is stated of several moduli, and of several image pairs, together."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from palpate.inversion import Bounds, Inversion, Posterior
from palpate.parallel import mapped
from palpate.statement.stated_posterior import StatedPosterior
from palpate.uncertainty import (
    NORMAL_95,
    Combination,
    GridErrors,
    agreement,
    joint_region,
    known_pairs,
    pair_estimates,
)

MOST_REGIONS = 3  # of the pairs of moduli that are correlated most


@dataclass(frozen=True, slots=True)
class PairAlone:
    """What one later image says alone: moduli (kPa, or ratios) with their 95 % intervals; nothing without a minimum.

    outlier: whether the others contradict it; influence: by how many standard deviations it moves the mean of all;
    noise_mm: standard deviation of its residuals' noise, by the kind of observation.
    """

    moduli: Mapping[str, float]
    interval95: Mapping[str, tuple[float, float]]
    outlier: bool
    influence: Mapping[str, float]
    noise_mm: Mapping[str, float]


@dataclass(frozen=True, slots=True)
class ImagePairs:
    """Several later images of one body, each alone and the mean of those that agree.

    heterogeneity_p: probability of differences so large if all had the same moduli; within_cv: within-subject
    coefficient of variation; mean, mean_interval95: random-effects mean of those that are no outliers.
    """

    alone: tuple[PairAlone, ...]
    heterogeneity_p: float
    within_cv: Mapping[str, float]
    mean: Mapping[str, float]
    mean_interval95: Mapping[str, tuple[float, float]]

    def with_intervals_of(self, tissues: Collection[str]) -> ImagePairs:
        """The same with intervals of these tissues alone: of a modulus that is not identified none is stated."""

        def kept(intervals: Mapping[str, tuple[float, float]]) -> dict[str, tuple[float, float]]:
            """Of intervals by tissue those that are stated."""
            return {tissue: ends for tissue, ends in intervals.items() if tissue in tissues}

        alone = tuple(replace(pair, interval95=kept(pair.interval95)) for pair in self.alone)
        return replace(self, alone=alone, mean_interval95=kept(self.mean_interval95))


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


def image_pairs_of(
    inversion: Inversion, bounds: Bounds, errors: GridErrors, frozen: Posterior | None = None
) -> ImagePairs | None:
    """Of the later images of a converged estimate, where two or more have a minimum alone; else None.

    errors: of the residuals on random grids, see `grid_errors`; frozen: the posterior, where it is known so.
    """
    mapping = inversion.objective.parameters
    if len(inversion.objective.states) < 2 or not inversion.minimum.converged:
        return None
    scale, names = mapping.scale_kpa, mapping.tissues
    every = pair_estimates(inversion.objective, inversion.minimum, bounds, errors, frozen)
    usable = every.converged
    if np.count_nonzero(usable) < 2:
        return None
    pairs = every.of(usable)
    found = agreement(pairs)

    def stated(
        theta: NDArray[np.float64], covariance: NDArray[np.float64]
    ) -> tuple[dict[str, float], dict[str, tuple[float, float]]]:
        """Values and 95 % intervals, by tissue, of log-moduli (n,) with their covariance (n, n)."""
        half = NORMAL_95 * np.sqrt(np.diag(covariance))
        ends = scale * np.exp(np.stack([theta - half, theta, theta + half]))
        lows, middle, highs = (dict(zip(names, row.tolist(), strict=True)) for row in ends)
        return middle, {name: (lows[name], highs[name]) for name in names}

    alone, left = list[PairAlone](), iter(range(np.count_nonzero(usable)))
    for state, converged in zip(inversion.objective.states, usable.tolist(), strict=True):
        own = PairAlone({}, {}, False, {}, {kind: noise.sd for kind, noise in state.noise.items()})
        if converged:
            s = next(left)
            values, intervals = stated(pairs.theta[s], pairs.covariance[s, :, s])
            influence = dict(zip(names, found.influence[s].tolist(), strict=True))
            own = PairAlone(values, intervals, bool(found.outlier[s]), influence, own.noise_mm)
        alone.append(own)
    mean, mean_interval = stated(found.theta, found.covariance)
    within = dict(zip(names, found.within_cv.tolist(), strict=True))
    return ImagePairs(tuple(alone), found.heterogeneity, within, mean, mean_interval)


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
