"""The posterior of the unknowns by sampling, with frozen closest points, and whether the chains have mixed."""

from __future__ import annotations

from dataclasses import dataclass
from importlib import import_module

import numpy as np
from numpy.typing import NDArray
from scipy import linalg

from palpate.approximation.contract import determined
from palpate.errors import EstimationError, ResourceError
from palpate.inversion import FrozenPosterior
from palpate.inversion.objective import Evaluation
from palpate.inversion.optimise import Bounds
from palpate.unknowns.blocks import in_series, in_series_slopes, of_series

STEP = 0.35  # length of a proposal, in standard deviations of the posterior
THIN = 10  # steps for each draw that is kept
SHRUNK = 1.0 - 1e-9  # factor on a start's distance, so that a start at a bound lies inside despite rounding
SPREAD = 1.5  # standard deviations between the chains' starts
BLOCK = 4000  # proposals drawn together: those of all steps would take gigabytes
LARGEST_R_HAT = 1.01
LEAST_ESS = 400.0  # of the bulk; with fewer, R-hat itself is too random
TAILS = (0.05, 0.95)  # quantiles


@dataclass(frozen=True, slots=True)
class PosteriorChains:
    """Markov chains side by side: log-moduli theta (chains, draws, n_parameters) that were kept.

    log_density (chains, draws): of all unknowns at each draw, but for a constant; accepted (chains,): the share of its
    proposals that each chain accepted.
    """

    theta: NDArray[np.float64]
    log_density: NDArray[np.float64]
    accepted: NDArray[np.float64]


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
    `start` (n,). Every chain starts elsewhere, at 1.5 standard deviations or where the density is not 0, and leaves out
    a tenth of its draws; a draw is the last of ten steps: x' = c + sqrt(1 - b^2) (x - c) + b L xi with L L^T = H^-1,
    preconditioned Crank-Nicolson, which a posterior that is exactly normal always accepts (Cotter, Roberts, Stuart &
    White, Stat. Sci. 28 (2013) 424-446). Raises `EstimationError` where a modulus moves nothing.

    Steps are made in y of what acts on moduli in series with the rest of a region (see `in_series`), not in its x: the
    log-moduli that go with it lie on a curve in x, and nearly on a line in y.
    """
    n, parameters = frozen.objective.n_parameters, frozen.objective.parameters
    coordinates = _SeriesCoordinates(frozen, parameters.acting_on_moduli, parameters.shares_on_moduli)
    slopes, start = coordinates.slopes(start), start.copy()
    start[coordinates.columns] = in_series(start[coordinates.columns], coordinates.shares)
    try:
        laplace = _Laplace(start, linalg.cholesky(evaluation.matrix / np.outer(slopes, slopes), lower=True))
    except linalg.LinAlgError as error:
        raise EstimationError(
            f"the Gauss-Newton matrix is not positive definite ({error}): some modulus moves nothing at this place, so"
            " its posterior cannot be sampled; start at a minimum"
        ) from error
    with determined():
        own = np.linalg.cholesky(evaluation.covariance_columns(n)[:n])
        stretch = np.asarray(np.linalg.cholesky(covariance) @ np.linalg.inv(own), dtype=np.float64)
    warm, steps = THIN * (draws // 10), THIN * draws
    found = []
    for generator in rng.spawn(chains):
        now = start + SPREAD * laplace.draws(1, generator)[0]
        inside = np.clip(start[:n] + stretch @ (now[:n] - start[:n]), bounds.lower, bounds.upper)
        now[:n] = start[:n] + SHRUNK * np.linalg.solve(stretch, inside - start[:n])
        while not np.isfinite(coordinates.energy(now)[0]):  # stiffer than any share makes it: no proposal leads out
            now = 0.5 * (start + now)
        parts, accepted = [], 0
        for done in range(0, warm + steps, BLOCK):
            several = min(BLOCK, warm + steps - done)
            *part, now, taken = _chain(
                coordinates, laplace, now, bounds=bounds, steps=several, rng=generator, stretch=stretch
            )
            parts.append(part)
            accepted += taken
        theta, energy = (np.concatenate(each)[warm + THIN - 1 :: THIN] for each in zip(*parts, strict=True))
        found.append((theta, -energy, accepted / (warm + steps)))
    thetas, densities, shares = zip(*found, strict=True)
    return PosteriorChains(np.stack(thetas), np.stack(densities), np.array(shares))


@dataclass(frozen=True, slots=True)
class _SeriesCoordinates:
    """A frozen posterior of the unknowns z, x but for y in place of those with numbers `columns` (n,)."""

    frozen: FrozenPosterior
    columns: NDArray[np.int64]
    shares: NDArray[np.float64]

    def slopes(self, unknowns: NDArray[np.float64]) -> NDArray[np.float64]:
        """Derivatives dz / dx (n_unknowns,) at unknowns x (n_unknowns,)."""
        found = np.ones(len(unknowns))
        found[self.columns] = in_series_slopes(unknowns[self.columns], self.shares)
        return found

    def energy(self, places: NDArray[np.float64]) -> tuple[float, float]:
        """Minus the log-density at z (n_unknowns,), of z and of x; infinite where there is no x."""
        unknowns = places.copy()
        unknowns[self.columns] = of_series(places[self.columns], self.shares)
        if not np.isfinite(unknowns).all():
            return np.inf, np.inf
        value = self.frozen.value(unknowns)
        return value + float(np.log(self.slopes(unknowns)[self.columns]).sum()), value


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


def _chain(
    coordinates: _SeriesCoordinates,
    laplace: _Laplace,
    start: NDArray[np.float64],
    *,
    bounds: Bounds,
    steps: int,
    rng: np.random.Generator,
    stretch: NDArray[np.float64],
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64], int]:
    """So many steps from unknowns z (n,); `stretch` (n_parameters, n_parameters): A of `posterior_chains`.

    Their log-moduli (steps, n_parameters), minus their log-density (steps,) before log-moduli are stretched, the end
    (n,), and how many proposals were taken.
    """
    centre = laplace.centre[: len(stretch)]
    n = len(centre)
    theta, energy, accepted = np.empty((steps, n)), np.empty(steps), 0
    now, (own, value) = start, coordinates.energy(start)
    level = own - laplace.energy(start)
    draws, thresholds = laplace.draws(steps, rng), np.log(rng.random(steps))
    for k in range(steps):
        trial = laplace.centre + np.sqrt(1.0 - STEP**2) * (now - laplace.centre) + STEP * draws[k]
        stretched = centre + stretch @ (trial[:n] - centre)
        if np.all((stretched >= bounds.lower) & (stretched <= bounds.upper)):
            own, there = coordinates.energy(trial)
            above = own - laplace.energy(trial)
            if thresholds[k] < level - above:
                now, value, level, accepted = trial, there, above, accepted + 1
        theta[k], energy[k] = centre + stretch @ (now[:n] - centre), value
    return theta, energy, now, accepted


@dataclass(frozen=True, slots=True)
class ChainDiagnostics:
    """Of each of n quantities, (n,) dimensionless: R-hat, effective sample sizes of bulk and tails.

    r_hat is NaN where no chain ever moved.
    """

    r_hat: NDArray[np.float64]
    ess_bulk: NDArray[np.float64]
    ess_tail: NDArray[np.float64]

    @property
    def mixed(self) -> NDArray[np.bool_]:
        """Which of them (n,) may be used: R-hat of at most 1.01, effective sample size of the bulk of at least 400."""
        return np.asarray((self.r_hat <= LARGEST_R_HAT) & (self.ess_bulk >= LEAST_ESS))


def require_arviz() -> None:
    """Raise `ResourceError` where arviz-stats is not installed."""
    try:
        import_module("arviz_stats.base")
    except ImportError as error:
        raise ResourceError(
            "whether samples have mixed is told by arviz-stats, which is not installed: pip install 'palpate[samples]';"
            " without --samples (with [estimate] samples = 0) the case is estimated all the same"
        ) from error


def chain_diagnostics(chains: NDArray[np.float64]) -> ChainDiagnostics:
    """Diagnostics of chains (n_chains, n_draws, n) of n quantities.

    Rank-normalised split R-hat; effective sample size of the bulk, and the smaller one of the quantiles of 5 % and 95 %
    (Vehtari, Gelman, Simpson, Carpenter & Burkner, Bayesian Analysis 16 (2021) 667-718). Raises `ResourceError` as
    `require_arviz` does.
    """
    require_arviz()
    statistics = import_module("arviz_stats.base").array_stats
    axes = {"chain_axis": 0, "draw_axis": 1}
    with np.errstate(divide="ignore", invalid="ignore"):  # of chains that never moved
        return ChainDiagnostics(
            np.asarray(statistics.rhat(chains, method="rank", **axes)),
            np.asarray(statistics.ess(chains, method="bulk", **axes)),
            np.asarray(statistics.ess(chains, method="tail", prob=TAILS, **axes)),
        )
