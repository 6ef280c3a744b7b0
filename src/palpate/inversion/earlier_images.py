"""What an estimate tells of the body, kept so that a later image can be added without the images that it saw.

The posterior of what all images share is a normal law under each scenario of the tissues. Over its prior it is the
likelihood of the images, and the prior for those that follow: Bayes' theorem, an image at a time.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy import linalg

from palpate.errors import ConfigurationError
from palpate.inversion.later_state import InverseProblem
from palpate.inversion.linear_evidence import SEEN
from palpate.inversion.mixture import Explanation, Mixture, beyond_bounds
from palpate.inversion.optimise import Bounds
from palpate.inversion.scenarios import Alternatives, scenarios_of
from palpate.unknowns.likelihood import Likelihood
from palpate.unknowns.parameters import ParameterMap

FLAT = 1e-6  # precision of ln E that stands for none while covariances are formed


@dataclass(frozen=True, slots=True)
class KnownBlock:
    """A block of the body: `size` unknowns x, of which the images tell z = rows x, rows (k, size).

    variances: of its terms, where they were learned: an amplitude stays as the first images tell it.
    """

    cause: str
    of: str
    size: int
    rows: NDArray[np.float64]
    variances: tuple[float, ...] = ()

    @property
    def in_words(self) -> str:
        """What it is."""
        return f"{self.cause} of '{self.of}' with {self.size} unknowns"


@dataclass(frozen=True, slots=True)
class ScenarioLaw:
    """The likelihood of theta and all z under one scenario, which is known by its levels (see `ParameterMap`)."""

    levels: tuple[int, ...]
    likelihood: Likelihood


@dataclass(frozen=True, slots=True)
class EarlierImages:
    """What `n_images` later images say of theta and of the body's `blocks`, under every scenario.

    theta (n_parameters,): the mean of its posterior, where an estimate with further images begins.
    """

    n_images: int
    theta: NDArray[np.float64]
    blocks: tuple[KnownBlock, ...]
    laws: tuple[ScenarioLaw, ...]

    def __post_init__(self) -> None:
        n = len(self.theta) + sum(len(of.rows) for of in self.blocks)
        shapes = [shape for of in self.laws for shape in (of.likelihood.matrix.shape, of.likelihood.pull.shape)]
        if not self.laws or shapes != [(n, n), (n,)] * len(self.laws):
            raise ConfigurationError(f"the laws of earlier images do not have {n} unknowns each, as their blocks do")
        for of in self.blocks:
            if of.rows.shape[1:] != (of.size,):
                raise ConfigurationError(f"combinations {of.rows.shape} are not of the {of.in_words}")

    def known_in(self, problem: InverseProblem) -> InverseProblem:
        """The problem of further images of the same body, in which the earlier ones count.

        Raises `ConfigurationError` where it has other log-moduli or blocks of the body than the earlier ones.
        """
        parameters = problem.parameters
        body = parameters.body_blocks
        own = [KnownBlock(b.cause, b.of, b.size, np.eye(b.size)) for b in (parameters.blocks[i] for i in body)]
        there, here = [of.in_words for of in self.blocks], [of.in_words for of in own]
        n, found = len(self.theta), parameters.n_parameters
        if (n, there) != (found, here):
            strange = [of for of in there if of not in here] + [of for of in here if of not in there]
            raise ConfigurationError(
                f"the earlier estimate knows {n} moduli and {len(there)} groups of other unknowns of the body, this"
                f" case has {found} and {len(here)}{f', for example {strange[0]}' if strange else ''}; estimate all"
                " images together"
            )
        blocks = list(parameters.blocks)
        for i, of in zip(body, self.blocks, strict=True):
            blocks[i] = blocks[i].with_variances(of.variances) if of.variances else blocks[i]
        rows = linalg.block_diag(np.eye(n), *(of.rows for of in self.blocks))
        earlier = {law.levels: law.likelihood.by(rows) for law in self.laws}
        return replace(problem, parameters=replace(parameters, blocks=tuple(blocks), priors=(), earlier=earlier))


def earlier_images(
    mixture: Mixture,
    parameters: ParameterMap,
    bounds: Bounds,
    *,
    n_images: int,
    wider: NDArray[np.float64],
    beside: NDArray[np.float64],
) -> EarlierImages:
    """What the images of a posterior say, and those that it has as `earlier`: `n_images` in all.

    The explanations of a scenario become one normal law with their mean and covariance. wider (n_parameters,): factor
    on every standard deviation of theta; beside (n_parameters, n_parameters): covariance of theta by errors of these
    images that the posterior leaves out. So they are not believed more than their own result states. A scenario that
    has no explanation left has the likelihood of the likeliest one, and at most the probability exp(-`SEEN`).
    """
    numbers, found = parameters.shared, dict[tuple[int, ...], Likelihood]()
    scenarios, odds = dict[tuple[int, ...], Alternatives](), dict[tuple[int, ...], float]()
    for of in scenarios_of(parameters.blocks):  # of the same tissues, whether the frame moves or not
        levels = parameters.choosing(dict(of.chosen)).levels
        scenarios[levels] = of
        odds[levels] = float(np.logaddexp(odds.get(levels, -np.inf), of.log_odds))
    groups = dict[tuple[int, ...], list[Explanation]]()
    for explanation in mixture.explanations:  # the likeliest first
        groups.setdefault(parameters.choosing(explanation.chosen).levels, []).append(explanation)
    likeliest, best = next(iter(groups)), np.log(max(sum(of.weight for of in group) for group in groups.values()))
    for levels in sorted(scenarios, key=lambda levels: levels not in groups):
        scenario = scenarios[levels]
        believed = parameters.choosing(dict(scenario.chosen))
        prior, centre = believed.prior_of_blocks.block(numbers, numbers), believed.prior_centre[numbers]
        if levels in groups:
            mean, precision, beyond = _normal_law(groups[levels], numbers, wider, beside, bounds)
            told = Likelihood(precision - prior, precision @ mean - prior @ centre, 0.0)
            level = np.log(sum(of.weight for of in groups[levels])) - odds[levels] + 0.5 * beyond
            found[levels] = replace(told, constant=told.log_evidence(prior, centre) - level)
            continue
        told = found[likeliest]
        level = told.log_evidence(prior, centre) + odds[levels]
        found[levels] = replace(told, constant=told.constant + max(level - (best - SEEN), 0.0))
    known = list[KnownBlock]()
    for i in parameters.body_blocks:
        block = parameters.blocks[i]
        rows = np.eye(block.size) if block.rows is None else block.rows
        known.append(KnownBlock(block.cause, block.of, rows.shape[1], rows, parameters.priors[i].variances))
    return EarlierImages(n_images, mixture.mean, tuple(known), tuple(ScenarioLaw(*of) for of in found.items()))


def _normal_law(
    explanations: Sequence[Explanation],
    numbers: NDArray[np.int64],
    wider: NDArray[np.float64],
    beside: NDArray[np.float64],
    bounds: Bounds,
) -> tuple[NDArray[np.float64], NDArray[np.float64], float]:
    """Mean (m,) and precision (m, m) of unknowns with numbers (m,), all else integrated out.

    And by how much, in ln, the bounds of theta narrow it. A modulus that moves nothing has no precision.
    """
    n, shares = len(wider), np.array([of.weight for of in explanations])
    shares /= shares.sum()
    places = np.stack([of.minimum.unknowns[numbers] for of in explanations])
    mean, covariance = shares @ places, np.zeros((len(numbers),) * 2)
    flat = np.diag(np.r_[np.full(n, FLAT), np.zeros(len(numbers) - n)])
    for share, place, of in zip(shares, places, explanations, strict=True):
        matrix = of.minimum.evaluation.matrix.grounded()
        own, _ = matrix.complement(numbers, np.zeros(matrix.size))
        open_ = numbers[~(of.minimum.evaluation.matrix.diagonal[numbers] > 0.0)]
        own[np.isin(numbers, open_), np.isin(numbers, open_)] = 0.0
        covariance += share * (np.linalg.inv(own + flat) + np.outer(place - mean, place - mean))
    factor = np.r_[wider, np.ones(len(numbers) - n)]
    covariance *= np.outer(factor, factor)
    covariance[:n, :n] += beside
    precision = np.linalg.inv(covariance) - flat / np.outer(factor, factor)
    unseen = np.r_[np.diag(precision)[:n] < FLAT, np.zeros(len(numbers) - n, dtype=bool)]
    precision[unseen], precision[:, unseen] = 0.0, 0.0
    of_theta = np.where(np.outer(unseen, unseen)[:n, :n] & np.eye(n, dtype=bool), np.inf, covariance[:n, :n])
    return mean, 0.5 * (precision + precision.T), beyond_bounds(of_theta, bounds)
