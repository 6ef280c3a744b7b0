"""Published tissue stiffness, to ask whether an estimate can be right."""

from __future__ import annotations

import math
import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from importlib.resources import files
from typing import Any

from palpate.findings import Finding
from palpate.images.tissue import Role
from palpate.study.case import Case
from palpate.study.estimated import Estimation

MARGIN = 3.0  # methods differ by ten to a hundred times: an estimate is doubtful only well outside what was published
SOFT_TISSUE_KPA = (0.05, 1000.0)  # of a tissue without published values, with room on both sides
GIVEN_MARGIN = 10.0  # a modulus that is given lies outside what was published for its name by methods, a slip by 1000


@dataclass(frozen=True, slots=True)
class PublishedStiffness:
    """Young's modulus (kPa) of a tissue from `low` to `high`, how it was measured, and where it was published.

    words: parts of a tissue's name that mean this tissue; unless: parts that mean another one all the same.
    """

    tissue: str
    words: Sequence[str]
    low: float
    high: float
    method: str
    source: str
    unless: Sequence[str] = ()

    @property
    def usual_kpa(self) -> float:
        """A Young's modulus (kPa) that the tissue may be given before anything better is known: the geometric mean."""
        return round(math.sqrt(self.low * self.high), 3)

    @property
    def reference(self) -> str:
        """How it was measured and where it was published."""
        return f"{self.method}; {self.source}"


TABLE: dict[str, list[dict[str, Any]]] = tomllib.loads((files("palpate.study") / "tissues.toml").read_text("utf-8"))
PUBLISHED = tuple(PublishedStiffness(**entry) for entry in TABLE["published"])


def published_for(name: str) -> tuple[PublishedStiffness, ...]:
    """The published values whose words occur in a tissue's `name`, whatever its case, blanks and hyphens."""
    plain = name.lower().replace(" ", "_").replace("-", "_")
    named = [entry for entry in PUBLISHED if any(word in plain for word in entry.words)]
    found = [entry for entry in named if not any(word in plain for word in entry.unless)]
    tumours = [entry for entry in found if entry.tissue == "prostate cancer"]
    return tuple(tumours or found)


def usual_stiffness(name: str) -> PublishedStiffness | None:
    """What was published for a tissue's name in the narrowest range; None when nothing was."""
    return min(published_for(name), key=lambda entry: entry.high / entry.low, default=None)


def plausibility_warnings(moduli_kpa: Mapping[str, float]) -> tuple[Finding, ...]:
    """Warnings on moduli (tissue name -> kPa) far outside what was published, each naming its source.

    A bladder is not compared with its wall: meshed as one solid it has an effective modulus, which none published.
    """
    found = []
    for name, value in moduli_kpa.items():
        walls = "wall" in name.lower()
        entries = [entry for entry in published_for(name) if walls or not entry.tissue.endswith("wall")]
        low, high = min((e.low for e in entries), default=0.0), max((e.high for e in entries), default=math.inf)
        if low / MARGIN <= value <= high * MARGIN:
            continue
        closest = min(entries, key=lambda entry: min(abs(value - entry.low), abs(value - entry.high)))
        text = (
            f"{name}: {value:.3g} kPa lies more than {MARGIN:g} times outside the published range for {closest.tissue}"
            f" ({low:g} to {high:g} kPa; nearest: {closest.reference}). Check the `known` tissue's"
            " modulus, the labels and the boundary before you believe it"
        )
        found.append(Finding("implausible-stiffness", text))
    return tuple(found)


def estimate_warnings(estimation: Estimation) -> tuple[Finding, ...]:
    """`plausibility_warnings` on what was estimated; none where the search did not converge: they would tell moduli."""
    if estimation.status != "converged":
        return ()
    return plausibility_warnings({e.tissue: e.value for e in estimation.estimates if e.value is not None})


def unit_warnings(case: Case) -> tuple[Finding, ...]:
    """Warnings on moduli in the case that look as if they were given in Pa or in MPa.

    By the range that was published for the tissue's name, ten times wider at both ends; for other names by that of soft
    tissue.
    """
    hints = []
    for name, value in [(t.name, t.modulus_kpa) for t in case.tissues if t.role is not Role.RIGID]:
        entries = published_for(name)
        low, high = min((e.low for e in entries), default=0.0), max((e.high for e in entries), default=0.0)
        low, high = (low / GIVEN_MARGIN, high * GIVEN_MARGIN) if entries else SOFT_TISSUE_KPA
        if value and not low <= value <= high:
            unit, factor = ("Pa", 1e-3) if value > high else ("MPa", 1e3)
            what = f"what was published of '{entries[0].tissue}', with room" if entries else "soft tissue"
            hints.append(
                Finding(
                    "units",
                    f"tissue '{name}': youngs_modulus_kpa = {value:g} is unusual for {what} ({low:g} to {high:g}"
                    f" kPa); if you meant {value:g} {unit}, write {value * factor:g}",
                )
            )
    return tuple(hints)
