"""What each of several later images says alone, and whether they agree."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from palpate.inversion import Bounds, Inversion, Posterior
from palpate.uncertainty import (
    NORMAL_95,
    GridErrors,
    agreement,
    pair_estimates,
)


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
