"""The posterior of the log-moduli: a mixture over all that may explain the later images.

Under each explanation, a scenario of the tissues with the alternatives of every later image (see `scenarios`), all
other unknowns are integrated out, and the posterior is nearly normal. The probability of an explanation is its
evidence, by Laplace's approximation.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray
from scipy import special

from palpate.approximation.contract import determined
from palpate.errors import EstimationError, SolverError
from palpate.inversion.frozen_posterior import Posterior
from palpate.inversion.laplace import MarginalMinimum, MarginalPosterior, Nearby
from palpate.inversion.linear_evidence import EVERY, Candidates, Compared, LinearEvidence
from palpate.inversion.objective import Evaluation
from palpate.inversion.optimise import Bounds, Minimum, Outcome, same_minimum
from palpate.parallel import mapped
from palpate.unknowns.parameters import ParameterMap, Volume

BESIDE = 1.0  # standard deviations: so near the minimum of another explanation one is seen with what is known there


@dataclass(frozen=True, slots=True)
class Explanation:
    """A scenario with the alternatives of every later image, its probability, and the posterior of theta under it.

    chosen: numbers of the alternatives, by block; scenario, images: in words; theta (n_parameters,) and covariance
    (n_parameters, n_parameters): of the log-moduli, normal; minimum: that of all unknowns with the `volume`, the room
    that theta leaves all others there; level: log of the probability but for a constant; group: of its scenario;
    number: of the minimum, where it has several.
    """

    chosen: Mapping[int, int]
    scenario: tuple[str, ...]
    images: tuple[tuple[str, ...], ...]
    weight: float
    theta: NDArray[np.float64]
    covariance: NDArray[np.float64]
    minimum: Minimum = field(repr=False)
    volume: Volume | None = None
    level: float = 0.0
    group: tuple[str, ...] = ()
    number: int = 0

    @property
    def key(self) -> tuple[int, tuple[tuple[int, int], ...]]:
        """What it chooses, and which of its minima it is."""
        return self.number, tuple(sorted(self.chosen.items()))

    def prior(self, parameters: ParameterMap) -> ParameterMap:
        """The unknowns as it believes them."""
        return replace(parameters.choosing(dict(self.chosen)), volume=self.volume)


@dataclass(frozen=True, slots=True)
class Mixture:
    """The posterior of theta: explanations with their weights, the likeliest first, which add up to 1."""

    explanations: tuple[Explanation, ...]

    @classmethod
    def of(cls, explanations: Iterable[Explanation]) -> Mixture:
        """That of explanations with the weights that their levels tell."""
        found = sorted(explanations, key=lambda of: -of.level)
        weights = np.exp([of.level - found[0].level for of in found])
        shares = (weights / weights.sum()).tolist()
        return cls(tuple(replace(of, weight=w) for of, w in zip(found, shares, strict=True) if w > 0.0))

    @property
    def level(self) -> float:
        """Log of the sum of the explanations' probabilities, but for the constant of their levels."""
        return float(special.logsumexp([of.level for of in self.explanations]))

    @property
    def minimum(self) -> Minimum:
        """That of the likeliest explanation, of all unknowns."""
        return self.explanations[0].minimum

    @property
    def weights(self) -> NDArray[np.float64]:
        """(n,) of the explanations."""
        return np.array([of.weight for of in self.explanations])

    @property
    def mean(self) -> NDArray[np.float64]:
        """(n_parameters,) of theta."""
        return np.asarray(self.weights @ np.stack([of.theta for of in self.explanations]))

    @property
    def mean_unknowns(self) -> NDArray[np.float64]:
        """(n_unknowns,) of all unknowns."""
        return np.asarray(self.weights @ np.stack([of.minimum.unknowns for of in self.explanations]))

    @property
    def covariance(self) -> NDArray[np.float64]:
        """(n_parameters, n_parameters) of theta: within explanations and between them."""
        away = np.stack([of.theta for of in self.explanations]) - self.mean
        within = np.tensordot(self.weights, np.stack([of.covariance for of in self.explanations]), axes=1)
        return np.asarray(within + (away.T * self.weights) @ away)

    @property
    def sd(self) -> NDArray[np.float64]:
        """(n_parameters,) of theta."""
        return np.asarray(np.sqrt(np.diag(self.covariance)))

    def probabilities(self, block: int) -> dict[int, float]:
        """Of the alternatives of a block that has any, by their numbers."""
        found = dict[int, float]()
        for of in self.explanations:
            if block in of.chosen:
                found[of.chosen[block]] = found.get(of.chosen[block], 0.0) + of.weight
        return found


def mixture_of(
    posterior: Posterior,
    unknowns: NDArray[np.float64],
    evaluation: Evaluation,
    bounds: Bounds,
    candidates: Candidates = EVERY,
    *,
    begins: Sequence[NDArray[np.float64]] = (),
    earlier: Mixture | None = None,
) -> Mixture:
    """The posterior of theta over the explanations that are `candidates`.

    First every explanation is compared with the residuals linear around unknowns (n_unknowns,), within `TRUSTED_SD`
    there (see `LinearEvidence`). Then the minimum of the likeliest is found on the `posterior`, however far, that of
    theta with all else integrated out, with the evidence there. begins (n_unknowns,) each: where further minima of the
    likeliest explanation are sought; earlier: what is known of explanations near by, where their minima are sought.
    Raises `EstimationError` where images and prior leave an unknown open, or no minimum can be solved for.
    """
    n = posterior.n_parameters
    with determined():
        compared = LinearEvidence.of(posterior.parameters, evaluation, unknowns).compared(candidates)
    known = {of.key: of.minimum.unknowns for of in (earlier.explanations if earlier else ())}
    first = dict[tuple[int, ...], Compared]()  # the likeliest of those in which the same unknowns act on moduli
    for of in compared:
        first.setdefault(_free(posterior.parameters, of), of)

    def sought(of: Compared) -> _Laplace | None:
        """That whose minimum is sought from where it was, or where it is as far as residuals are linear."""
        begin = known.get((0, tuple(sorted(of.chosen))), of.unknowns)
        return _laplace(posterior, bounds, of, begin, candidates.places)

    led = dict(zip(first, mapped(sought, first.values()), strict=True))

    def beside(of: Compared) -> _Laplace | None:
        """That of another explanation, seen from where the likeliest one led, or found on its own."""
        leads = led[_free(posterior.parameters, of)]
        seen = None if leads is None else _laplace_beside(posterior, bounds, of, leads)
        return seen or sought(of)

    rest = [of for of in compared if all(of is not other for other in first.values())]
    found = [each for each in (*led.values(), *mapped(beside, rest)) if each is not None]
    if not found:
        raise EstimationError("the model cannot be solved near any explanation of the images; check images and mesh")
    likeliest = max(found, key=lambda each: each.level)
    others = [(posterior, bounds, likeliest.of, begin, candidates.places) for begin in begins]
    for each in mapped(lambda job: _laplace(*job), others):
        same = [other.found.minimum for other in found if other.of is likeliest.of]
        if each is not None and not any(same_minimum(each.found.minimum.unknowns, other, n) for other in same):
            found.append(each)
    squares = posterior(unknowns)
    robust = (evaluation.value - evaluation.prior_value) - (squares.value - squares.prior_value)  # of outliers
    return Mixture.of(
        Explanation(
            dict(each.of.chosen),
            each.of.scenario.words,
            each.of.images,
            1.0,
            each.found.minimum.unknowns[:n],
            each.found.covariance,
            each.found.minimum,
            each.found.volume,
            each.level - robust,
            each.of.scenario.group,
            sum(other.of is each.of for other in found[:i]),
        )
        for i, each in enumerate(found)
    )


@dataclass(frozen=True, slots=True)
class _Laplace:
    """The minimum of an explanation on the model, what is known around it, and the log of its probability."""

    of: Compared
    found: MarginalMinimum
    nearby: Nearby
    level: float


def _laplace(
    posterior: Posterior, bounds: Bounds, of: Compared, begin: NDArray[np.float64], places: int
) -> _Laplace | None:
    """An explanation, its minimum sought from unknowns (n_unknowns,); None where the model cannot be solved there."""
    own = posterior.with_prior(posterior.parameters.choosing(dict(of.chosen)))
    try:
        found, nearby = MarginalPosterior.of(own).seen_at_minimum(begin, bounds, places)
    except SolverError:
        return None
    return _levelled(own.parameters, bounds, of, found, nearby)


def _laplace_beside(posterior: Posterior, bounds: Bounds, of: Compared, leads: _Laplace) -> _Laplace | None:
    """An explanation with what is known around the minimum of another one; None where its own is too far from there."""
    own = replace(posterior.parameters.choosing(dict(of.chosen)), volume=None)
    nearby = leads.nearby.with_prior(own)
    parabola = nearby.parabola()
    target, away = parabola.minimum(bounds)
    if away > BESIDE:
        return None
    try:
        found = nearby.at_minimum(MarginalPosterior.of(posterior.with_prior(own)), target, parabola, Outcome.CONVERGED)
    except SolverError:
        return None
    return _levelled(own, bounds, of, found, nearby)


def _free(parameters: ParameterMap, of: Compared) -> tuple[int, ...]:
    """Numbers of the unknowns beside theta that act on moduli under an explanation."""
    return tuple(parameters.choosing(dict(of.chosen)).free_on_moduli.tolist())


def _levelled(
    parameters: ParameterMap, bounds: Bounds, of: Compared, found: MarginalMinimum, nearby: Nearby
) -> _Laplace | None:
    """The log-evidence -M - 1/2 ln det d2M/dt2 + 1/2 ln det P, less what variances are more than bounds leave."""
    if not np.isfinite(found.value):
        return None
    determinants = sum(prior.log_determinant for prior in parameters.priors) - beyond_bounds(found.covariance, bounds)
    return _Laplace(of, found, nearby, of.log_prior + of.several + 0.5 * determinants - found.value)


def beyond_bounds(covariance: NDArray[np.float64], bounds: Bounds) -> float:
    """Sum of ln of by how much variances (n, n) of theta are more than bounds leave, 1/12 of their distance squared."""
    room = bounds.room / np.sqrt(12.0)
    seen = np.isfinite(np.diag(covariance)) & (room > 0.0)
    variances = np.linalg.eigvalsh((covariance / np.outer(*(np.where(seen, room, 1.0),) * 2))[np.ix_(seen, seen)])
    return float(np.log(np.maximum(variances, 1.0)).sum())
