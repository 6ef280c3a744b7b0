"""Samples of the moduli's posterior: Markov chains around the estimate, and whether they have mixed."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from importlib import import_module
from typing import Any

import numpy as np
from numpy.typing import NDArray

from palpate.errors import ResourceError
from palpate.findings import Finding, listing
from palpate.inversion import Bounds
from palpate.study.case import SAMPLES, Case
from palpate.study.stated_posterior import StatedPosterior
from palpate.uncertainty import (
    ChainDiagnostics,
    Interval,
    chain_diagnostics,
    posterior_chains,
    require_arviz,
)

POSTERIOR = "posterior.nc"
CHAINS = 4
TAIL = 0.025  # on either side of a 95 % interval


@dataclass(frozen=True, slots=True)
class ModulusSamples:
    """Draws of Young's moduli (CHAINS, draws, n) of n `tissues` in `unit`, kPa or a ratio, from Markov chains.

    log_density (CHAINS, draws): of all unknowns at each draw, but for a constant; accepted (CHAINS,): the share of its
    proposals that each chain accepted; interval95 (n, 2): equal-tailed, in `unit`, with 95 % of the draws; NaN at an
    end where that of the estimate is open, for there nothing but the bounds of the search ends the draws.
    """

    tissues: tuple[str, ...]
    unit: str
    moduli: NDArray[np.float64]
    log_density: NDArray[np.float64]
    accepted: NDArray[np.float64]
    interval95: NDArray[np.float64]
    diagnostics: ChainDiagnostics

    def to_dict(self) -> dict[str, Any]:
        """What `result.json` says of them."""
        found = self.diagnostics
        each = zip(self.tissues, self.interval95, found.r_hat, found.ess_bulk, found.ess_tail, strict=True)
        rows = [
            {
                "tissue": tissue,
                "unit": self.unit,
                "interval95": interval,
                "r_hat": r_hat,
                "ess_bulk": bulk,
                "ess_tail": tail,
            }
            for tissue, interval, r_hat, bulk, tail in each
        ]
        chains, draws = self.log_density.shape
        return {
            "file": POSTERIOR,
            "chains": chains,
            "draws": draws,
            "interval_probability": 1.0 - 2.0 * TAIL,
            "accepted": self.accepted,
            "moduli": rows,
        }


def require_samples(case: Case) -> None:
    """Raise `ResourceError` where the case asks for samples and a library for them is not installed."""
    if not case.estimate.samples:
        return
    require_arviz()
    try:
        for name in ("h5py", "h5netcdf"):
            import_module(name)
    except ImportError as error:
        raise ResourceError(
            f"{POSTERIOR} is written by h5netcdf, which is not installed: pip install 'palpate[samples]'; the estimate"
            " itself works without --samples ([estimate] samples = 0)"
        ) from error


def draw_moduli(
    posterior: StatedPosterior,
    intervals: Sequence[Interval | None],
    *,
    bounds: Bounds,
    draws: int,
    rng: np.random.Generator,
) -> ModulusSamples:
    """So many draws in each chain around the minimum of a posterior, with its covariance (see `posterior_chains`).

    intervals: of the estimates, whose ends may be open. Raises `EstimationError` where a modulus moves nothing,
    `ResourceError` as `require_arviz` does.
    """
    mapping, minimum = posterior.frozen.objective.parameters, posterior.minimum
    n = len(mapping.tissues)  # Poisson's ratios are drawn with them, and not stated
    chains = posterior_chains(
        posterior.frozen,
        minimum.unknowns,
        minimum.evaluation,
        posterior.covariance,
        bounds=bounds,
        chains=CHAINS,
        draws=draws,
        rng=rng,
    )
    moduli = mapping.scale_kpa * np.exp(chains.theta[..., :n])
    ends = np.quantile(moduli, [TAIL, 1.0 - TAIL], axis=(0, 1)).T
    is_open = np.array([[end is None for end in interval or (None, None)] for interval in intervals])
    return ModulusSamples(
        mapping.tissues,
        "kPa" if mapping.absolute else "ratio",
        moduli,
        chains.log_density,
        chains.accepted,
        np.where(is_open, np.nan, ends),
        chain_diagnostics(chains.theta[..., :n]),
    )


def sample_findings(samples: ModulusSamples | None) -> tuple[Finding, ...]:
    """A finding where the chains of some modulus have not mixed."""
    if samples is None or samples.diagnostics.mixed.all():
        return ()
    found = samples.diagnostics
    open_ = [
        f"'{samples.tissues[i]}' (R-hat {found.r_hat[i]:.3f}, {found.ess_bulk[i]:.0f} effective draws)"
        for i in np.flatnonzero(~found.mixed).tolist()
    ]
    draws = samples.log_density.shape[1]
    rest = (
        ", where R-hat should be at most 1.01 with 400 effective draws. The estimates do not use them; for better draws"
        f" set --samples {min(4 * draws, SAMPLES[1])}."
    )
    text = listing(f"The chains of {draws} draws have not mixed for ", open_, rest)
    return (Finding("samples-not-mixed", text),)
