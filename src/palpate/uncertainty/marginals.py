"""What is stated of each log-modulus: a mixture of the normal laws of all explanations, its quantiles and causes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy import optimize, special

from palpate.inversion import Mixture
from palpate.uncertainty.covariance import Covariance
from palpate.uncertainty.intervals import Interval, ModulusInterval
from palpate.uncertainty.profile import Profile
from palpate.unknowns import Block, Choice

CORRELATED = 1.5  # largest factor on a standard deviation by which residuals that are alike over surfaces count
TAIL = 0.025  # on either side of a 95 % interval
TABLE = 4001  # places of ln E at which the coordinate is tabulated
FLAT = 0.1  # least slope of a profile's root deviance beyond its end, over that at the estimate


@dataclass(frozen=True, slots=True)
class StatedMixture:
    """The posterior with all that is known of its errors: weights (k,), theta (k, n), covariances (k, n, n).

    covariance: of the whole, by cause.
    """

    weights: NDArray[np.float64]
    theta: NDArray[np.float64]
    covariances: NDArray[np.float64]
    covariance: Covariance

    def draws(self, number: int, rng: np.random.Generator) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
        """So many explanations (number,), and how far theta (number, n) lies from the estimate of each."""
        which = rng.choice(len(self.weights), size=number, p=self.weights)
        roots = np.stack([np.linalg.cholesky(covariance) for covariance in self.covariances])
        normal = rng.standard_normal((number, self.theta.shape[1]))
        return which, np.asarray(np.einsum("dij,dj->di", roots[which], normal))


def stated_mixture(mixture: Mixture, own: Covariance, blocks: tuple[Block, ...]) -> StatedMixture:
    """A mixture whose explanations have the errors of the likeliest one, `own`, beside those of the posterior.

    Residuals are alike over surfaces in other ways than their number says: with the sandwich C_s and H^-1 of the
    likeliest explanation, every standard deviation is larger by the factor (C_s / H^-1)^(1/2), 1 to `CORRELATED`. What
    blocks that are held, the voxels' place and the mesh add is the same in all. The variance is that within
    explanations and that between their means (law of total variance). By how much it is larger than that of the
    likeliest one is told by what distinguishes them.
    """
    held, factor = own.of_held, correlated_factor(own)
    sandwich = own.noise + own.prior - held
    every = np.stack([np.outer(factor, factor) * of.covariance for of in mixture.explanations])
    weights, theta = mixture.weights, np.stack([of.theta for of in mixture.explanations])
    within, away = np.tensordot(weights, every, axes=1), theta - mixture.mean
    groups = _groups(mixture, blocks)
    apart, variances = np.asarray((away.T * weights) @ away), np.diagonal(every, axis1=1, axis2=2)
    between = _shared(apart, {cause: weights @ (of @ away) ** 2 for cause, of in groups.items()})
    means = {cause: of @ variances for cause, of in groups.items()}
    wider = _shared(within - every[0], {cause: weights @ (of - of[0]) for cause, of in means.items()})
    told = sum(wider.values(), np.zeros_like(within))
    scale = np.sqrt(np.diag(within - told) / np.diag(sandwich))
    scaled, causes = np.outer(scale, scale), dict[str, NDArray[np.float64]]()
    for cause, part in own.causes.items():
        of_held = own.held.get(cause, np.zeros_like(part))
        causes[cause] = (part - of_held) * scaled + of_held
    for cause, part in (*between.items(), *wider.items()):
        causes[cause] = causes.get(cause, np.zeros_like(part)) + part
    noise, known = own.noise * scaled, held + own.grid + own.mesh
    prior = within + apart + held - noise
    whole = replace(own, noise=noise, prior=prior, causes=causes)
    return StatedMixture(weights, theta, every + known, whole)


def correlated_factor(own: Covariance) -> NDArray[np.float64]:
    """The factor (n,) on each standard deviation, 1 to `CORRELATED`, by residuals that are alike over surfaces."""
    sandwich = own.noise + own.prior - own.of_held
    return np.clip(np.sqrt(np.diag(sandwich) / np.diag(own.plain)), 1.0, CORRELATED)


def _groups(mixture: Mixture, blocks: tuple[Block, ...]) -> Mapping[str, NDArray[np.float64]]:
    """By the causes of blocks whose alternatives distinguish explanations: how each averages over those that are alike.

    (k, k) times values (k, n) of the explanations is, for each, the mean over all with the same alternatives of these
    blocks. What none of them tells apart are minima: each without the mean over those that are alike in all.
    """
    found, chosen = dict[str, NDArray[np.float64]](), [of.chosen for of in mixture.explanations]
    weights = np.maximum(mixture.weights, np.finfo(float).tiny)

    def averaging(keys: Sequence[object]) -> NDArray[np.float64]:
        """Over explanations with the same key."""
        alike = np.array([[one == other for other in keys] for one in keys]) * weights
        return np.asarray(alike / alike.sum(axis=1, keepdims=True))

    for choice in (choice for choice in Choice if choice.of_explanations):
        own = [i for i, block in enumerate(blocks) if block.choice is choice]
        keys = [tuple(of.get(i, 0) for i in own) for of in chosen]
        if len(set(keys)) > 1:
            found[blocks[own[0]].cause] = averaging(keys)
    every = [tuple(sorted(of.items())) for of in chosen]
    if len(set(every)) < len(every):
        found["minima"] = np.eye(len(every)) - averaging(every)
    return found


def _shared(whole: NDArray[np.float64], parts: Mapping[str, NDArray[np.float64]]) -> Mapping[str, NDArray[np.float64]]:
    """A covariance (n, n) by causes, whose variances are shared as `parts` (n,) are; nothing of a negative one."""
    positive = {cause: np.maximum(part, 0.0) for cause, part in parts.items()}
    total = np.maximum(sum(positive.values(), np.zeros(len(whole))), np.finfo(float).tiny)
    found = dict[str, NDArray[np.float64]]()
    for cause, part in positive.items():
        share = np.sqrt(part / total) * (np.diag(whole) > 0.0)
        found[cause] = whole * np.outer(share, share)
    return found


@dataclass(frozen=True, slots=True)
class Marginal:
    """The posterior of one log-modulus: a mixture of laws that are normal in the coordinate of a profile.

    weights, theta, sd (k,) of the explanations; profile: of the likeliest one, whose signed root deviance r is a
    coordinate in which that one's posterior is normal, where ln E is none; None where ln E is; spread: its standard
    deviation.
    """

    weights: NDArray[np.float64]
    theta: NDArray[np.float64]
    sd: NDArray[np.float64]
    profile: Profile | None
    spread: float

    def coordinate(self, theta: NDArray[np.float64] | float) -> NDArray[np.float64]:
        """The coordinate (n,) of ln E, as long as ln E at the estimate: the spread times r, beyond its ends a line."""
        there = np.atleast_1d(np.asarray(theta, dtype=np.float64))
        if self.profile is None or len(self.profile.theta) < 2:
            return np.asarray(there - self.theta[0])
        places, roots = self.profile.theta, np.maximum.accumulate(self.profile.root)
        found = self.spread * np.interp(there, places, roots)
        for end, side, inner in ((0, there < places[0], 1), (-1, there > places[-1], -2)):
            steps = places[end] - places[inner]
            slope = self.spread * (roots[end] - roots[inner]) / steps if steps else 1.0
            found[side] += max(float(slope), FLAT) * (there[side] - places[end])
        return np.asarray(found)

    def at(self, which: NDArray[np.int64], away: NDArray[np.float64]) -> NDArray[np.float64]:
        """Ln E (n,) that lie `away` (n,) from the estimates of explanations `which` (n,) in the coordinate.

        By a table.
        """
        places = self.coordinate(self.theta)[which] + away
        reach = float(np.abs(away).max(initial=0.0)) / FLAT
        table = np.linspace(float(self.theta.min()) - reach, float(self.theta.max()) + reach, TABLE)
        return np.asarray(np.interp(places, self.coordinate(table), table))

    def quantile(self, probability: float, bounds: tuple[float, float]) -> float | None:
        """Ln E below which it lies with a probability; None beyond the bounds of the search."""
        centres = self.coordinate(self.theta)

        def excess(theta: float) -> float:
            """The probability of a smaller ln E, less that."""
            away = (self.coordinate(theta)[0] - centres) / self.sd
            return float(self.weights @ special.ndtr(away)) - probability

        low, high = bounds
        if excess(low) >= 0.0 or excess(high) <= 0.0:
            return None
        return float(optimize.brentq(excess, low, high, xtol=1e-6))

    def interval(self, bounds: tuple[float, float]) -> Interval:
        """The equal-tailed 95 % interval of E as a ratio to the scale.

        An end is open beyond the bounds, and beyond the places to which the profile could be followed.
        """
        low, high = self.quantile(TAIL, bounds), self.quantile(1.0 - TAIL, bounds)
        if self.profile is not None:
            first, last = float(self.profile.theta[0]), float(self.profile.theta[-1])
            low = None if low is None or (self.profile.low is None and low < first) else low
            high = None if high is None or (self.profile.high is None and high > last) else high
        return (None if low is None else float(np.exp(low)), None if high is None else float(np.exp(high)))


def marginals_of(stated: StatedMixture, intervals: Sequence[ModulusInterval]) -> tuple[Marginal, ...]:
    """That of each parameter, by the `intervals` of the likeliest explanation: by their profiles where these lean."""
    found = []
    for i, of in enumerate(intervals):
        sd, profile = np.sqrt(stated.covariances[:, i, i]), of.profile if of.kind == "profile" else None
        found.append(Marginal(stated.weights, stated.theta[:, i], sd, profile, float(sd[0])))
    return tuple(found)
