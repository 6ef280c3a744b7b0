"""The posterior of the unknowns by sampling, with frozen closest points."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import linalg

from palpate.errors import EstimationError
from palpate.inversion import FrozenPosterior, frozen_posterior
from palpate.inversion.objective import Evaluation, Objective, determined
from palpate.inversion.optimise import Bounds
from palpate.parallel import blas_on_one_thread

__all__ = [
    "PosteriorChains",
    "PosteriorSamples",
    "posterior_chains",
    "sample_posterior",
]

STEP = 0.35  # of a proposal, in standard deviations of the posterior
THIN = 10  # steps of a draw that is kept
SHRUNK = 1.0 - 1e-9  # of a start's distance: one at a bound lies inside whatever rounding does
SPREAD = 1.5  # standard deviations, by which chains start apart
BETWEEN_CHECKS = 4000  # evaluations
GAP = 1.0  # of log-likelihood, that the frozen posterior may be off; re-chosen closest points alone make some tenths


@dataclass(frozen=True, slots=True)
class PosteriorSamples:
    """A Markov chain: log-moduli theta (n_evaluations, n_parameters) and the share of its proposals that it accepted.

    refreshed: how often closest points were chosen anew; gap: the largest error (log-likelihood) of the frozen
    posterior that a check found.
    """

    theta: NDArray[np.float64]
    accepted: float
    refreshed: int
    gap: float

    def interval(self, share: float = 0.95) -> NDArray[np.float64]:
        """Equal-tailed credible interval (n_parameters, 2) of the log-moduli that holds `share` of the samples."""
        tail = 0.5 * (1.0 - share)
        return np.asarray(np.quantile(self.theta, [tail, 1.0 - tail], axis=0).T)


@dataclass(frozen=True, slots=True)
class PosteriorChains:
    """Markov chains side by side: log-moduli theta (chains, draws, n_parameters) that were kept.

    log_density (chains, draws): of all unknowns at each draw, but for a constant; accepted (chains,): the share of its
    proposals that each chain accepted.
    """

    theta: NDArray[np.float64]
    log_density: NDArray[np.float64]
    accepted: NDArray[np.float64]


@blas_on_one_thread()
def sample_posterior(
    objective: Objective,
    start: NDArray[np.float64],
    *,
    bounds: Bounds,
    evaluations: int,
    rng: np.random.Generator,
) -> PosteriorSamples:
    """Sample the posterior around a minimum `start` (n,) with so many evaluations.

    Preconditioned Crank-Nicolson steps x' = c + sqrt(1 - b^2) (x - c) + b L xi with L L^T = H^-1, which a posterior
    that is exactly normal always accepts (Cotter, Roberts, Stuart & White, Stat. Sci. 28 (2013) 424-446). Every 4000
    evaluations the objective itself is asked; where the frozen one is off by more than 1, it is frozen anew. Raises
    `EstimationError` where a modulus moves nothing, `ConfigurationError` for models that are not reduced ones.
    """
    evaluation = objective(start)
    frozen = frozen_posterior(objective, start, evaluation)
    laplace = _laplace(start, evaluation)
    anchor = evaluation.value - frozen.value(start)
    now, chain, counts, gap, refreshed = start, [], 0, 0.0, 0
    for done in range(0, evaluations, BETWEEN_CHECKS):
        steps = min(BETWEEN_CHECKS, evaluations - done)
        stretch = _chain(frozen, laplace, now, bounds=bounds, steps=steps, rng=rng)
        now = stretch.end
        chain.append(stretch.theta)
        counts += stretch.accepted
        off = abs(objective.value(now) - frozen.value(now) - anchor)
        gap = max(gap, off)
        if off > GAP:
            frozen = frozen_posterior(objective, now)
            anchor, refreshed = objective.value(now) - frozen.value(now), refreshed + 1
    return PosteriorSamples(np.concatenate(chain), counts / evaluations, refreshed, gap)


def posterior_chains(
    frozen: FrozenPosterior,
    start: NDArray[np.float64],
    evaluation: Evaluation,
    covariance: NDArray[np.float64],
    *,
    bounds: Bounds,
    chains: int,
    draws: int,
    rng: np.random.Generator,
) -> PosteriorChains:
    """Chains of so many draws of a frozen posterior p, the log-moduli spread as all that is known of them is.

    The density that is sampled is p(c + A^-1 (theta - c), q) of log-moduli theta between the bounds and all other
    unknowns q, with the minimum c: A = L M^-1 stretches the log-moduli, M M^T their covariance by the Gauss-Newton
    matrix, L L^T = `covariance` (n_parameters, n_parameters), that by correlated residuals, prior and grid (the
    open-faced sandwich: Shaby, J. Comput. Graph. Stat. 23 (2014) 853-876). evaluation: of the objective at the minimum
    `start` (n,). Every chain starts elsewhere, at 1.5 standard deviations, and leaves out a tenth of its draws; a draw
    is the last of ten steps. Raises `EstimationError` where a modulus moves nothing.
    """
    n = frozen.objective.n_parameters
    laplace = _laplace(start, evaluation)
    with determined():
        own = np.linalg.cholesky(evaluation.covariance_columns(n)[:n])
        stretch = np.asarray(np.linalg.cholesky(covariance) @ np.linalg.inv(own), dtype=np.float64)
    warm, steps = THIN * (draws // 10), THIN * draws
    found = []
    for generator in rng.spawn(chains):
        now = start + SPREAD * laplace.draws(1, generator)[0]
        inside = np.clip(start[:n] + stretch @ (now[:n] - start[:n]), bounds.lower, bounds.upper)
        now[:n] = start[:n] + SHRUNK * np.linalg.solve(stretch, inside - start[:n])
        parts = []
        for done in range(0, warm + steps, BETWEEN_CHECKS):  # proposals of all steps at once would take gigabytes
            several = min(BETWEEN_CHECKS, warm + steps - done)
            parts.append(_chain(frozen, laplace, now, bounds=bounds, steps=several, rng=generator, stretch=stretch))
            now = parts[-1].end
        kept = slice(warm + THIN - 1, None, THIN)
        theta = np.concatenate([part.theta for part in parts])[kept]
        density = -np.concatenate([part.energy for part in parts])[kept]
        accepted = sum(part.accepted for part in parts) / (warm + steps)
        found.append((theta, density, accepted))
    thetas, densities, shares = zip(*found, strict=True)
    return PosteriorChains(np.stack(thetas), np.stack(densities), np.array(shares))


def _laplace(start: NDArray[np.float64], evaluation: Evaluation) -> _Laplace:
    try:
        return _Laplace(start, linalg.cholesky(evaluation.matrix, lower=True))
    except linalg.LinAlgError as error:
        raise EstimationError(
            f"the Gauss-Newton matrix is not positive definite ({error}): some modulus moves nothing at this place, so"
            " its posterior cannot be sampled; start at a minimum"
        ) from error


@dataclass(frozen=True, slots=True)
class _Laplace:
    """The normal law N(centre, H^-1) of the proposals, H = factor factor^T."""

    centre: NDArray[np.float64]
    factor: NDArray[np.float64]

    def energy(self, unknowns: NDArray[np.float64]) -> float:
        """1/2 (x - c)^T H (x - c) of unknowns x (n_unknowns,), dimensionless."""
        scaled = self.factor.T @ (unknowns - self.centre)
        return 0.5 * float(scaled @ scaled)

    def draws(self, n: int, rng: np.random.Generator) -> NDArray[np.float64]:
        """Samples (n, n_unknowns) of N(0, H^-1)."""
        normal = rng.standard_normal((len(self.centre), n))
        return np.asarray(linalg.solve_triangular(self.factor.T, normal, lower=False).T)


@dataclass(frozen=True, slots=True)
class _Stretch:
    """Of a chain: its log-moduli (steps, n_parameters), minus their log-density (steps,), its end (n,) before it.

    That is before log-moduli are stretched; accepted: how many proposals it took.
    """

    theta: NDArray[np.float64]
    energy: NDArray[np.float64]
    end: NDArray[np.float64]
    accepted: int


def _chain(
    frozen: FrozenPosterior,
    laplace: _Laplace,
    start: NDArray[np.float64],
    *,
    bounds: Bounds,
    steps: int,
    rng: np.random.Generator,
    stretch: NDArray[np.float64] | None = None,
) -> _Stretch:
    """So many steps from unknowns (n,); `stretch` (n_parameters, n_parameters): A of `posterior_chains`, or none."""
    n = frozen.objective.n_parameters
    centre = laplace.centre[:n]
    stretch = np.eye(n) if stretch is None else stretch
    theta, energy, accepted = np.empty((steps, n)), np.empty(steps), 0
    now, value = start, frozen.value(start)
    level = value - laplace.energy(start)
    draws, thresholds = laplace.draws(steps, rng), np.log(rng.random(steps))
    for k in range(steps):
        trial = laplace.centre + np.sqrt(1.0 - STEP**2) * (now - laplace.centre) + STEP * draws[k]
        stretched = centre + stretch @ (trial[:n] - centre)
        if np.all((stretched >= bounds.lower) & (stretched <= bounds.upper)):
            there = frozen.value(trial)
            above = there - laplace.energy(trial)
            if thresholds[k] < level - above:
                now, value, level, accepted = trial, there, above, accepted + 1
        theta[k], energy[k] = centre + stretch @ (now[:n] - centre), value
    return _Stretch(theta, energy, now, accepted)
