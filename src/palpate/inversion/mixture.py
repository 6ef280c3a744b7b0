"""The posterior of the log-moduli: a mixture over all that may explain the later images.

Under each explanation, a scenario of the tissues with the alternatives of every later image (see `scenarios`), all
other unknowns are integrated out, and the posterior is nearly normal. The probability of an explanation is its
evidence, by Laplace's approximation.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial

import numpy as np
from numpy.typing import NDArray
from scipy import linalg, special

from palpate.approximation.contract import determined
from palpate.errors import EstimationError, SolverError
from palpate.inversion.frozen_posterior import Posterior
from palpate.inversion.laplace import PLACES, MarginalMinimum, MarginalPosterior, Nearby
from palpate.inversion.objective import Evaluation
from palpate.inversion.optimise import Bounds, Minimum, Outcome, same_minimum
from palpate.inversion.scenarios import Alternatives, alternatives_of, frames_of, scenarios_of
from palpate.mechanics.solvers.cholesky import backward, forward, lower_factor
from palpate.parallel import mapped
from palpate.unknowns.arrowhead import Arrowhead
from palpate.unknowns.blocks import Alternative, Choice
from palpate.unknowns.parameters import ParameterMap, Volume

FAR_SEEN = 20.0  # the same of the likeliest one with layers, or without: its minimum may be far away
TRUSTED_SD = 0.5  # of ln E: how far residuals are taken for linear where explanations are compared first
SEEN = 6.0  # of the log-evidence: explanations that are less likely than the best one by so much are left out
MOST = 12  # explanations of a group whose minimum is sought on the model
ROUNDS = 4  # over all images, to find the likeliest alternatives of each
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


@dataclass(frozen=True, slots=True)
class Candidates:
    """The explanations that are compared: those of the scenarios that are `kept`.

    The minima of the likeliest are sought, `most` at most, and `of_group` of one group where that is a number, from so
    many `places`.
    """

    kept: Callable[[Alternatives], bool] = lambda _: True
    most: int = MOST
    of_group: int | None = None
    places: int = PLACES


EVERY = Candidates()


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
    first = dict[tuple[int, ...], _Compared]()  # the likeliest of those in which the same unknowns act on moduli
    for of in compared:
        first.setdefault(_free(posterior.parameters, of), of)

    def sought(of: _Compared) -> _Laplace | None:
        """That whose minimum is sought from where it was, or where it is as far as residuals are linear."""
        begin = known.get((0, tuple(sorted(of.chosen))), of.unknowns)
        return _laplace(posterior, bounds, of, begin, candidates.places)

    led = dict(zip(first, mapped(sought, first.values()), strict=True))

    def beside(of: _Compared) -> _Laplace | None:
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
class _Compared:
    """An explanation on linear residuals: its choices, in words too, its minimum (n_unknowns,) and log-evidence.

    log_prior: log prior odds of its alternatives; several: what combinations of alternatives of several images add,
    which are none of the compared ones.
    """

    chosen: tuple[tuple[int, int], ...]
    scenario: Alternatives
    images: tuple[tuple[str, ...], ...]
    unknowns: NDArray[np.float64]
    evidence: float
    log_prior: float
    several: float


@dataclass(frozen=True, slots=True)
class _Laplace:
    """The minimum of an explanation on the model, what is known around it, and the log of its probability."""

    of: _Compared
    found: MarginalMinimum
    nearby: Nearby
    level: float


def _laplace(
    posterior: Posterior, bounds: Bounds, of: _Compared, begin: NDArray[np.float64], places: int
) -> _Laplace | None:
    """An explanation, its minimum sought from unknowns (n_unknowns,); None where the model cannot be solved there."""
    own = posterior.with_prior(posterior.parameters.choosing(dict(of.chosen)))
    try:
        found, nearby = MarginalPosterior.of(own).seen_at_minimum(begin, bounds, places)
    except SolverError:
        return None
    return _levelled(own.parameters, bounds, of, found, nearby)


def _laplace_beside(posterior: Posterior, bounds: Bounds, of: _Compared, leads: _Laplace) -> _Laplace | None:
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


def _free(parameters: ParameterMap, of: _Compared) -> tuple[int, ...]:
    """Numbers of the unknowns beside theta that act on moduli under an explanation."""
    return tuple(parameters.choosing(dict(of.chosen)).free_on_moduli.tolist())


def _levelled(
    parameters: ParameterMap, bounds: Bounds, of: _Compared, found: MarginalMinimum, nearby: Nearby
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


def log_det(matrix: Arrowhead) -> float:
    """Ln det of a positive definite matrix, without the unknowns that nothing depends on."""
    return matrix.grounded().log_determinant()


@dataclass(frozen=True, slots=True)
class _Eliminated:
    """What an image's own unknowns y, under one of its alternatives P, take from the shared ones.

    taken (n_shared, n_shared) and pull (n_shared,): A_sy (A_yy + P)^-1 A_ys and A_sy (A_yy + P)^-1 b_y; level: 1/2
    (b_y^T (A_yy + P)^-1 b_y - ln det(A_yy + P) + ln det P) with the log prior odds. own (n_own,): their numbers in the
    order in which they are eliminated, by `steps`.
    """

    own: NDArray[np.int64]
    steps: tuple[_Step, ...]
    taken: NDArray[np.float64]
    pull: NDArray[np.float64]
    level: float

    def following(self, of_shared: NDArray[np.float64]) -> NDArray[np.float64]:
        """The unknowns `own` (n_own,) at their best beside shared ones (n_shared,)."""
        found = np.append(of_shared, -1.0)
        for step in reversed(self.steps):
            found = np.concatenate([backward(step.factor, -step.border @ found), found])
        return found[: len(self.own)]


@dataclass(frozen=True, slots=True)
class _OfImage:
    """An alternative of a later image: how its `frame` moves, by block, how it is `drawn`, and what is eliminated."""

    frame: Mapping[int, int]
    drawn: Alternatives
    eliminated: _Eliminated


@dataclass(frozen=True, slots=True)
class _Step:
    """A block of m unknowns eliminated before n others that follow, and a right-hand side.

    factor L (m, m) of their matrix with its prior; border (m, n + 1): L^-1 of their rows of the others and the
    right-hand side; left (n + 1, n + 1): what is left of these; determinant: ln det of the prior less that of L L^T.
    """

    factor: NDArray[np.float64]
    border: NDArray[np.float64]
    left: NDArray[np.float64]
    determinant: float

    @classmethod
    def of(cls, matrix: NDArray[np.float64], prior: Alternative) -> _Step:
        """The first m unknowns of a matrix (m + n + 1, m + n + 1) under their prior."""
        m = len(prior.covariance)
        factor = lower_factor(matrix[:m, :m] + prior.precision)
        border = forward(factor, matrix[:m, m:])
        determinant = prior.log_determinant - 2.0 * float(np.log(np.diag(factor)).sum())
        return cls(factor, border, matrix[m:, m:] - border.T @ border, determinant)


def _likeliest_together(gains: Sequence[Mapping[int, float]], most: int) -> dict[tuple[int, ...], float]:
    """Combinations of one number of each image with the sum of their gains, those above -`SEEN`, `most` at most."""
    found: list[tuple[tuple[int, ...], float]] = [((), 0.0)]
    for of in gains:
        longer = [((*numbers, i), level + gain) for numbers, level in found for i, gain in of.items()]
        found = sorted((each for each in longer if each[1] > -SEEN), key=lambda each: -each[1])[:most]
    return dict(found)


def _log_evidence(matrix: NDArray[np.float64], pull: NDArray[np.float64]) -> float:
    """1/2 (b^T A^-1 b - ln det A) of a positive definite matrix A (n, n) and a pull b (n,)."""
    factor = lower_factor(matrix)
    target = forward(factor, pull)
    return 0.5 * float(target @ target) - float(np.log(np.diag(factor)).sum())


@dataclass(frozen=True, slots=True)
class LinearEvidence:
    """The log-evidence of explanations on residuals that are linear in all unknowns.

    information (n_shared, n_shared) and pull (n_shared,) of the unknowns that several images share, whose numbers are
    `shared` (n_shared,); images: of each the alternatives, and what each takes when its own unknowns follow.
    """

    parameters: ParameterMap
    shared: NDArray[np.int64]
    information: NDArray[np.float64]
    pull: NDArray[np.float64]
    images: tuple[tuple[_OfImage, ...], ...]

    @classmethod
    def of(cls, parameters: ParameterMap, evaluation: Evaluation, unknowns: NDArray[np.float64]) -> LinearEvidence:
        """That of residuals linear around unknowns (n_unknowns,), where moduli are trusted within `TRUSTED_SD`."""
        n, data = parameters.n_parameters, evaluation.matrix - evaluation.prior
        pull = data @ unknowns - (evaluation.score - evaluation.prior_score)
        data = data.plus([(np.arange(n), TRUSTED_SD**-2.0 * np.eye(n))])
        pull[:n] += TRUSTED_SD**-2.0 * unknowns[:n]
        owns = [parameters.of_image(state) for state in range(parameters.n_states)]
        shared = np.setdiff1d(np.arange(len(pull)), np.concatenate(owns))
        images = [tuple(cls._eliminated(parameters, data, pull, s, shared)) for s in range(parameters.n_states)]
        return cls(parameters, shared, data.block(shared, shared), pull[shared], tuple(images))

    @staticmethod
    def _eliminated(
        parameters: ParameterMap,
        data: Arrowhead,
        pull: NDArray[np.float64],
        state: int,
        shared: NDArray[np.int64],
    ) -> Iterator[_OfImage]:
        """Each alternative of a later state, under each motion of its frame, with what its own unknowns take.

        Block after block is eliminated, those that may be otherwise last: alternatives that begin alike share it.
        """
        frames, drawings = frames_of(parameters.blocks, state), alternatives_of(parameters.blocks, state)
        every = [(dict(frame), alternatives) for frame in frames for alternatives in drawings]
        open_ = list(dict.fromkeys(i for frame, alternatives in every for i in (*frame, *dict(alternatives.chosen))))
        blocks = [*(i for i in parameters.blocks_of_image(state) if i not in open_), *open_]
        own = np.concatenate([np.zeros(0, dtype=np.int64), *(parameters.columns(i) for i in blocks)])
        border = np.column_stack([data.block(own, shared), pull[own]])
        corner = np.zeros((border.shape[1],) * 2)
        whole, known = np.block([[data.block(own, own), border], [border.T, corner]]), dict[tuple[int, ...], _Step]()
        for frame, alternatives in every:
            chosen, steps, path = frame | dict(alternatives.chosen), list[_Step](), tuple[int, ...]()
            for i in blocks:
                path = (*path, chosen.get(i, -1))
                if path not in known:
                    prior = parameters.blocks[i].alternatives[chosen[i]] if i in chosen else parameters.priors[i]
                    known[path] = _Step.of(steps[-1].left if steps else whole, prior)
                steps.append(known[path])
            left = steps[-1].left if steps else corner
            level = 0.5 * (sum(step.determinant for step in steps) - float(left[-1, -1])) + alternatives.log_odds
            eliminated = _Eliminated(own, tuple(steps), -left[:-1, :-1], -left[:-1, -1], level)
            yield _OfImage(frame, alternatives, eliminated)

    def compared(self, candidates: Candidates) -> list[_Compared]:
        """The likeliest explanations among the candidates.

        Of several images the alternatives of each are chosen in turn, beside those of the others. Which combinations
        are likely is then told by what each of an image's alternatives loses alone.
        """
        most, of_group = candidates.most, candidates.of_group
        found, counts = list[tuple[float, Alternatives, Callable[[], _Compared]]](), dict[tuple[str, ...], int]()
        for scenario in scenarios_of(self.parameters.blocks):
            if candidates.kept(scenario):
                found += [(evidence, scenario, minimum) for evidence, minimum in self._of_scenario(scenario, most)]
        best, chosen = max(evidence for evidence, *_ in found), list[_Compared]()
        blocks, known = self.parameters.blocks, set[tuple[tuple[int, int], ...]]()
        for evidence, scenario, minimum in sorted(found, key=lambda each: -each[0]):
            number = counts[scenario.group] = counts.get(scenario.group, 0) + 1
            layers = tuple(pair for pair in scenario.chosen if blocks[pair[0]].choice is Choice.LAYERS)
            least = best - (SEEN if layers in known else FAR_SEEN)
            if evidence > least and len(chosen) < most and (of_group is None or number <= of_group):
                chosen.append(minimum())
                known.add(layers)
        return chosen

    def _of_scenario(self, scenario: Alternatives, most: int) -> list[tuple[float, Callable[[], _Compared]]]:
        """Its likeliest explanation, and those seen beside it, `most` at most: evidence, and what finds the minimum."""
        parameters, shared = self.parameters.choosing(dict(scenario.chosen)), self.shared
        prior, n = parameters.prior_matrix.block(shared, shared), parameters.n_parameters
        chosen = dict(scenario.chosen)
        images = [[of for of in image if of.frame.items() <= chosen.items()] for image in self.images]
        believed, centre = parameters.prior_of_blocks.block(shared, shared), parameters.prior_centre[shared]
        own = 0.5 * (log_det(Arrowhead.of(believed[n:, n:])) - float(centre @ believed @ centre)) + scenario.log_odds
        own -= parameters.earlier_constant
        information, pull = self.information + prior, self.pull + parameters.prior_pull[shared]

        def evidence(numbers: Sequence[int], k: int | None = None) -> list[float]:
            """The log-evidence of alternatives by their number in each image, of all those of image k in its place."""
            parts = [image[i].eliminated for j, (image, i) in enumerate(zip(images, numbers, strict=True)) if j != k]
            matrix, right = information - sum(part.taken for part in parts), pull - sum(part.pull for part in parts)
            level = own + sum(part.level for part in parts)
            if k is None:
                return [level + _log_evidence(matrix, right)]
            each = [of.eliminated for of in images[k]]
            return [level + part.level + _log_evidence(matrix - part.taken, right - part.pull) for part in each]

        def others(numbers: tuple[int, ...], k: int) -> dict[tuple[int, ...], float]:
            """All explanations that differ from one in image k alone, and itself."""
            every = [(*numbers[:k], i, *numbers[k + 1 :]) for i in range(len(images[k]))]
            return dict(zip(every, evidence(numbers, k), strict=True))

        numbers = tuple(max(range(len(image)), key=lambda i: image[i].eliminated.level) for image in images)
        by_image = [dict[tuple[int, ...], float]() for _ in images]
        for _ in range(ROUNDS if len(images) > 1 else 1):
            before = numbers
            for k in range(len(images)):
                by_image[k] = others(numbers, k)
                numbers = max(by_image[k], key=lambda each: by_image[k][each])
            if numbers == before:
                break
        else:  # the first images' are of other alternatives of the last ones
            by_image = [others(numbers, k) for k in range(len(images))] if len(images) > 1 else by_image
        best = max(level for of in by_image for level in of.values()) if by_image else evidence(())[0]
        gains = [{each[k]: level - best for each, level in of.items()} for k, of in enumerate(by_image)]
        together = _likeliest_together(gains, most)
        every = [float(np.log(np.sum(np.exp(list(of.values()))))) for of in gains]
        several = sum(every) - float(np.log(np.sum(np.exp(list(together.values())))))
        levels = {each: evidence(each)[0] for each in together}
        best = max(levels.values())
        seen = [(each, level) for each, level in levels.items() if level > best - SEEN]
        return [
            (level + several, partial(self._compared, scenario, parts, level + several, several, prior, pull))
            for parts, level in (([of[i] for of, i in zip(images, each, strict=True)], level) for each, level in seen)
        ]

    def _compared(
        self,
        scenario: Alternatives,
        parts: Sequence[_OfImage],
        evidence: float,
        several: float,
        prior: NDArray[np.float64],
        pull: NDArray[np.float64],
    ) -> _Compared:
        """One explanation with its minimum (n_unknowns,)."""
        matrix = self.information + prior - sum(part.eliminated.taken for part in parts)
        of_shared = linalg.solve(matrix, pull - sum(part.eliminated.pull for part in parts), assume_a="pos")
        unknowns = np.empty(self.parameters.n_unknowns)
        unknowns[self.shared] = of_shared
        for part in parts:
            unknowns[part.eliminated.own] = part.eliminated.following(of_shared)
        chosen = scenario.chosen + tuple(pair for part in parts for pair in part.drawn.chosen)
        odds = scenario.log_odds + sum(part.drawn.log_odds for part in parts)
        words = tuple(part.drawn.words for part in parts)
        return _Compared(chosen, scenario, words, unknowns, evidence, odds, several)
