"""The evidence of explanations on residuals that are linear in all unknowns: which of them are worth a search.

Given what later images share, the unknowns of one image do not touch those of another. So each image's are eliminated
under each of its alternatives, and any combination of these is a sum over images.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
from numpy.typing import NDArray
from scipy import linalg

from palpate.inversion.laplace import PLACES
from palpate.inversion.objective import Evaluation
from palpate.inversion.scenarios import Alternatives, alternatives_of, frames_of, scenarios_of
from palpate.mechanics.solvers.cholesky import backward, forward, lower_factor
from palpate.unknowns.arrowhead import Arrowhead
from palpate.unknowns.blocks import Alternative, Choice
from palpate.unknowns.parameters import ParameterMap

TRUSTED_SD = 0.5  # of ln E: how far residuals are taken for linear where explanations are compared first
SEEN = 6.0  # of the log-evidence: explanations that are less likely than the best one by so much are left out
FAR_SEEN = 20.0  # the same of the likeliest one with layers, or without: its minimum may be far away
MOST = 12  # explanations of a group whose minimum is sought on the model
ROUNDS = 4  # over all images, to find the likeliest alternatives of each


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


@dataclass(frozen=True, slots=True)
class Compared:
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

    def compared(self, candidates: Candidates) -> list[Compared]:
        """The likeliest explanations among the candidates.

        Of several images the alternatives of each are chosen in turn, beside those of the others. Which combinations
        are likely is then told by what each of an image's alternatives loses alone.
        """
        most, of_group = candidates.most, candidates.of_group
        found, counts = (
            list[tuple[float, Alternatives, Callable[[], Compared]]](),
            dict[tuple[str, ...], int](),
        )
        for scenario in scenarios_of(self.parameters.blocks):
            if candidates.kept(scenario):
                found += [(evidence, scenario, minimum) for evidence, minimum in self._of_scenario(scenario, most)]
        best, chosen = max(evidence for evidence, *_ in found), list[Compared]()
        blocks, known = self.parameters.blocks, set[tuple[tuple[int, int], ...]]()
        for evidence, scenario, minimum in sorted(found, key=lambda each: -each[0]):
            number = counts[scenario.group] = counts.get(scenario.group, 0) + 1
            layers = tuple(pair for pair in scenario.chosen if blocks[pair[0]].choice is Choice.LAYERS)
            least = best - (SEEN if layers in known else FAR_SEEN)
            if evidence > least and len(chosen) < most and (of_group is None or number <= of_group):
                chosen.append(minimum())
                known.add(layers)
        return chosen

    def _of_scenario(self, scenario: Alternatives, most: int) -> list[tuple[float, Callable[[], Compared]]]:
        """Its likeliest explanation, and those seen beside it, `most` at most: evidence, and what finds the minimum."""
        parameters, shared = self.parameters.choosing(dict(scenario.chosen)), self.shared
        prior, n = parameters.prior_matrix.block(shared, shared), parameters.n_parameters
        chosen = dict(scenario.chosen)
        images = [[of for of in image if of.frame.items() <= chosen.items()] for image in self.images]
        believed, centre = parameters.prior_of_blocks.block(shared, shared), parameters.prior_centre[shared]
        own = 0.5 * (_log_det(Arrowhead.of(believed[n:, n:])) - float(centre @ believed @ centre)) + scenario.log_odds
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
    ) -> Compared:
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
        return Compared(chosen, scenario, words, unknowns, evidence, odds, several)


def _log_det(matrix: Arrowhead) -> float:
    """Ln det of a positive definite matrix, without the unknowns that nothing depends on."""
    return matrix.grounded().log_determinant()
