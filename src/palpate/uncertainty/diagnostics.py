"""Whether Markov chains have mixed: rank-normalised split R-hat, effective sample sizes, by arviz-stats."""

from __future__ import annotations

from dataclasses import dataclass
from importlib import import_module

import numpy as np
from numpy.typing import NDArray

from palpate.errors import ResourceError

LARGEST_R_HAT = 1.01
LEAST_ESS = 400.0  # of the bulk, for R-hat itself is a number of chance with fewer
TAILS = (0.05, 0.95)  # quantiles


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
