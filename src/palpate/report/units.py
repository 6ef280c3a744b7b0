"""The unit in which pages and figures show moduli: the one place that decides it, and that brings numbers to it."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

from palpate.statement.stiffness_scale import modulus_label
from palpate.uncertainty import NORMAL_95, Interval
from palpate.unknowns import KNOWN_MODULUS

UnitName = Literal["kPa", "ratio"]


@dataclass(frozen=True, slots=True)
class ModulusUnit:
    """How moduli are shown: in kPa, or as ratios to the modulus of the tissue `relative_to`.

    reference_kpa: the modulus of that tissue by which a number in kPa is divided, None where numbers are ratios
    already; true_reference_kpa: its true modulus, None where that is not known.
    """

    name: UnitName
    relative_to: str
    reference_kpa: float | None = None
    true_reference_kpa: float | None = None

    @property
    def text(self) -> str:
        """What stands behind a number: "kPa", or "× surroundings"."""
        return "kPa" if self.name == "kPa" else f"× {self.relative_to}"

    @property
    def axis(self) -> str:
        """The label of an axis or a colour bar: "Young's modulus (kPa)", or "E / E of surroundings (ratio)"."""
        return modulus_label(self.name, self.relative_to)

    def numbers(self, item: Mapping[str, Any]) -> tuple[float | None, Interval | None]:
        """Value and 95 % interval of an entry of "estimates", in this unit; None where there is none."""
        if self.name == "kPa":
            return item["value"], item["interval95"]
        return item["ratio"], item["ratio_interval95"]

    def truth(self, item: Mapping[str, Any]) -> float | None:
        """The true modulus of an entry of "estimates", in this unit; None where one of the two is not known."""
        true_kpa: float | None = item["truth"]
        if self.name == "kPa" or true_kpa is None:
            return true_kpa
        return None if self.true_reference_kpa is None else true_kpa / self.true_reference_kpa

    def of_document(self, number: float) -> float:
        """A modulus of the document's lists (starts, regions, image pairs; kPa or a ratio there), in this unit."""
        return number / self.reference_kpa if self.name == "ratio" and self.reference_kpa else number

    def ends(self, item: Mapping[str, Any], value: float, ends: Interval) -> tuple[float, float]:
        """A closed interval about a value of that tissue in the document's lists, in this unit.

        Where the known modulus is a range, its part is taken out of a ratio's, as in `profile`.
        """
        low, high = (end or math.nan for end in ends)
        if self.name == "kPa" or not self.reference_kpa:
            return low, high
        out = NORMAL_95 * scale_sd(item)
        halves = (math.sqrt(max(math.log(end / value) ** 2 - out**2, 0.0)) for end in (low, high))
        below, above = halves
        middle = self.of_document(value)
        return middle * math.exp(-below), middle * math.exp(above)

    def profile(self, item: Mapping[str, Any]) -> tuple[tuple[float, float], ...]:
        """The profile of an entry of "estimates" in this unit: values with signed root deviances.

        Where the known modulus is a range, its part s^2 of the variance of ln E leaves the distance h of a value from
        the best one, at the root deviance r: h -> sqrt(h^2 - (r s)^2), as in the interval of the ratio.
        """
        points = tuple((float(at), float(root)) for at, root in item["profile"])
        centre, ratio, sd = item["value"], item["ratio"], scale_sd(item)
        if self.name == "kPa" or item["unit"] == "ratio" or not centre or not ratio:
            return points
        moved = []
        for at, root in points:
            half = math.log(at / centre)
            less = math.sqrt(max(half**2 - (root * sd) ** 2, 0.0))
            moved.append((ratio * math.exp(math.copysign(less, half)), root))
        return tuple(moved)


def shown_unit(document: Mapping[str, Any], name: UnitName | None = None) -> ModulusUnit:
    """The unit for the moduli of a document result.json (or sensitivity.json), which all its figures share.

    Ratios, where no modulus is known in kPa or one of them is known as a ratio alone (verdict `ratio only`); else kPa.
    name: the unit that is asked for instead; a document in ratios has no kPa, and one whose scale known loads set has
    no ratios: then `numbers` has none.
    """
    items = [item for item in document["estimates"] if item.get("parameter", "youngs_modulus") == "youngs_modulus"]
    in_ratios = any(item["unit"] == "ratio" or item["verdict"] == "ratio only" for item in items)
    to = next((item["relative_to"] for item in items), "")
    both = next((item for item in items if item["value"] and item["ratio"]), None)
    given = document.get("case", {}).get("tissues", {}).get(to, {}).get("youngs_modulus_kpa")
    return ModulusUnit(
        name or ("ratio" if in_ratios else "kPa"),
        to,
        both and both["value"] / both["ratio"],
        given if isinstance(given, float | int) else None,
    )


def given_text(document: Mapping[str, Any], tissue: str, kpa: float) -> str:
    """A known modulus as the case gives it: "10 kPa", or "4 to 25 kPa" where that is a range about `kpa`."""
    given = document["case"].get("tissues", {}).get(tissue, {}).get("youngs_modulus_kpa")
    if isinstance(given, list | tuple):
        return f"{given[0]:g} to {given[1]:g} kPa"
    return f"{kpa:g} kPa"


def scale_sd(item: Mapping[str, Any]) -> float:
    """Standard deviation of ln E that the range of the known modulus leaves in an entry of "estimates", dimensionless.

    From the half-widths of its two intervals in ln, h of E and h' of the ratio: sqrt(h^2 - h'^2) / 1.96.
    """
    if item["interval95"] is None or item["ratio_interval95"] is None:
        return 0.0
    for end, of_ratio in zip(item["interval95"], item["ratio_interval95"], strict=True):
        if end and of_ratio and item["value"] and item["ratio"]:
            squares = math.log(end / item["value"]) ** 2 - math.log(of_ratio / item["ratio"]) ** 2
            return math.sqrt(max(squares, 0.0)) / NORMAL_95
    return 0.0


def shown_correlation(document: Mapping[str, Any]) -> list[list[float | None]]:
    """Correlation of what is shown, in the order of "estimates": where that are ratios, without the scale they share.

    With the share f of the known modulus in a variance: (rho_ij - sqrt(f_i f_j)) / sqrt((1 - f_i)(1 - f_j)); None where
    nothing else is in it.
    """
    if shown_unit(document).name == "kPa":
        return [list(row) for row in document["correlation"]]
    shares = [(item.get("variance_shares") or {}).get(KNOWN_MODULUS, 0.0) for item in document["estimates"]]

    def without(i: int, j: int, rho: float | None) -> float | None:
        """One entry of the matrix."""
        left = math.sqrt(max((1.0 - shares[i]) * (1.0 - shares[j]), 0.0))
        if rho is None or left < 1e-6:
            return None
        return 1.0 if i == j else max(-1.0, min(1.0, (rho - math.sqrt(shares[i] * shares[j])) / left))

    return [[without(i, j, rho) for j, rho in enumerate(row)] for i, row in enumerate(document["correlation"])]


def shown_region(
    document: Mapping[str, Any], region: Mapping[str, Any]
) -> tuple[list[tuple[float, float]], list[tuple[float, float]]]:
    """Boundary and ellipse of a joint region in the unit that is shown: places (n, 2) each.

    Where the known modulus is a range, its part of both variances of ln E is taken out: places keep their ln E_1 / E_2
    and move along the shared scale, towards its mean at that ratio, by the ratio of the standard deviations there
    without it and with it. That is exact where both are normal.
    """
    unit = shown_unit(document)
    names = [item["tissue"] for item in document["estimates"]]
    numbers = [names.index(tissue) for tissue in region["tissues"]]
    items = [document["estimates"][number] for number in numbers]
    shares = [(item.get("variance_shares") or {}).get(KNOWN_MODULUS, 0.0) for item in items]
    sds = [scale_sd(item) for item in items]
    places = [[tuple(place) for place in region[of]] for of in ("boundary", "ellipse")]
    if unit.name == "kPa" or not all(item["value"] and item["ratio"] for item in items):
        return places[0], places[1]
    centre = [math.log(item["value"]) for item in items]
    to = [math.log(item["ratio"]) for item in items]
    slope, factor = 0.0, 1.0
    if all(share > 0.0 for share in shares) and all(sd > 0.0 for sd in sds):
        a, b = (sd**2 / share for sd, share in zip(sds, shares, strict=True))
        both = document["correlation"][numbers[0]][numbers[1]] * math.sqrt(a * b)
        across, along, mixed = a + b - 2.0 * both, a + b + 2.0 * both, a - b  # of the difference, of the sum
        slope = mixed / across if across > 0.0 else 0.0
        left = along - mixed * slope
        factor = math.sqrt(max(left - (sds[0] + sds[1]) ** 2, 0.0) / left) if left > 0.0 else 1.0

    def moved(place: Sequence[float]) -> tuple[float, float]:
        """One place as ratios."""
        first, second = (math.log(number) - middle for number, middle in zip(place, centre, strict=True))
        apart = first - second
        total = slope * apart + factor * (first + second - slope * apart)
        return math.exp(to[0] + 0.5 * (total + apart)), math.exp(to[1] + 0.5 * (total - apart))

    return [moved(place) for place in places[0]], [moved(place) for place in places[1]]
