"""Samples of the moduli's posterior: draws from the mixture that is stated."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from palpate.uncertainty import Interval, Marginal, StatedMixture
from palpate.unknowns import ParameterMap

POSTERIOR = "posterior.nc"
TAIL = 0.025  # on either side of a 95 % interval


@dataclass(frozen=True, slots=True)
class ModulusSamples:
    """Independent draws of Young's moduli (draws, n) of n `tissues` in `unit`, kPa or a ratio.

    interval95 (n, 2): equal-tailed, in `unit`, with 95 % of the draws; NaN at an end where that of the estimate is
    open.
    """

    tissues: tuple[str, ...]
    unit: str
    moduli: NDArray[np.float64]
    interval95: NDArray[np.float64]

    def to_dict(self) -> dict[str, Any]:
        """What `result.json` says of them."""
        rows = [
            {"tissue": tissue, "unit": self.unit, "interval95": interval}
            for tissue, interval in zip(self.tissues, self.interval95, strict=True)
        ]
        return {
            "file": POSTERIOR,
            "draws": len(self.moduli),
            "interval_probability": 1.0 - 2.0 * TAIL,
            "moduli": rows,
        }


def draw_moduli(
    mapping: ParameterMap,
    mixture: StatedMixture,
    marginals: Sequence[Marginal],
    intervals: Sequence[Interval],
    *,
    draws: int,
    rng: np.random.Generator,
) -> ModulusSamples:
    """So many independent draws of the stated posterior: an explanation by its probability, ln E by its normal law.

    Normal in the coordinate of each modulus' profile (see `Marginal`). intervals: of the moduli, whose ends may be
    open.
    """
    which, away = mixture.draws(draws, rng)
    theta = np.column_stack([of.at(which, away[:, i]) for i, of in enumerate(marginals)])
    moduli = mapping.scale_kpa * np.exp(theta)
    is_open = np.array([[end is None for end in interval] for interval in intervals])
    ends = np.quantile(moduli, [TAIL, 1.0 - TAIL], axis=0).T
    return ModulusSamples(
        mapping.tissues, "kPa" if mapping.absolute else "ratio", moduli, np.where(is_open, np.nan, ends)
    )
