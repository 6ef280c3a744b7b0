"""How Young's modulus is shown in colours: the unit, the limits and the colours that every picture of a case shares."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import matplotlib as mpl
import numpy as np
from numpy.typing import NDArray

COLOURS = "viridis"  # matplotlib's map: its brightness rises evenly, and it does not rest on red and green
ROOM = 0.12  # of the logarithmic range, left free at both ends
LEAST_ROOM = 1.15  # the factor that is left free at both ends at least
LETTERS = 24  # of a tissue's name beside the colours


@dataclass(frozen=True, slots=True)
class StiffnessScale:
    """A logarithmic scale of colours from `low` to `high`, in `unit`: "kPa", or "ratio" to the tissue `relative_to`.

    factor: what a modulus in the result's unit is multiplied by to be shown, dimensionless; values: the moduli of the
    tissues that are shown, each once, from the lowest up.
    """

    unit: str
    relative_to: str
    factor: float
    low: float
    high: float
    values: tuple[float, ...]

    @property
    def label(self) -> str:
        """What stands beside the colours."""
        return modulus_label(self.unit, self.relative_to)

    def linear_table(self) -> NDArray[np.float64]:
        """256 colours (256, 3), 0 to 1, at equal steps of the modulus from `low` to `high`.

        This is the table of a program that spreads colours linearly over its window.
        """
        values = np.linspace(self.low, self.high, 256)
        place = np.log(values / self.low) / math.log(self.high / self.low)
        return np.asarray(mpl.colormaps[COLOURS](place)[:, :3])


def modulus_label(unit: str, relative_to: str) -> str:
    """What an axis or a colour bar of moduli is called, in "kPa" or as a "ratio" to the tissue `relative_to`."""
    return "Young's modulus (kPa)" if unit == "kPa" else f"E / E of {relative_to[:LETTERS]} (ratio)"


def stiffness_scale(
    moduli: Sequence[float | None],
    *,
    unit: str,
    relative_to: str,
    factor: float,
    mapped: NDArray[np.floating] | None = None,
) -> StiffnessScale:
    """The scale of the moduli of tissues, of which some may be None or NaN, shown in `unit` after a `factor`.

    mapped (n,): moduli of the elements of tissues with a map, in the result's unit; the limits hold 99 % of them.
    Raises `ValueError` where no tissue has a modulus.
    """
    values = tuple(sorted({factor * value for value in moduli if value and value > 0.0}))
    if not values:
        raise ValueError("no tissue has a modulus")
    ends = [values[0], values[-1]]
    if mapped is not None and len(mapped):
        ends += [factor * float(end) for end in np.quantile(mapped, [0.005, 0.995])]
    low, high = min(ends), max(ends)
    room = max((high / low) ** ROOM, LEAST_ROOM)
    return StiffnessScale(unit, relative_to, factor, low / room, high * room, values)
