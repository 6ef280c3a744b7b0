"""Published tissue stiffness, to ask whether an estimate can be right."""

from __future__ import annotations

import math
import tomllib
from collections.abc import Mapping
from dataclasses import dataclass
from importlib.resources import files
from typing import Any

from palpate.body.poisson_ratios import NOT_IDENTIFIED
from palpate.case.case import Case
from palpate.case.tissue_names import found_word
from palpate.findings import Finding
from palpate.images.tissue import Role
from palpate.statement.estimation import Estimation
from palpate.uncertainty import NORMAL_95

MARGIN = 3.0  # methods differ by ten to a hundred times: an estimate is doubtful only well outside what was published
SOFT_TISSUE_KPA = (0.05, 1000.0)  # of a tissue without published values, with room on both sides
GIVEN_MARGIN = 10.0  # a modulus that is given lies outside what was published for its name by methods, a slip by 1000


@dataclass(frozen=True, slots=True)
class PublishedStiffness:
    """Young's modulus (kPa) of a tissue from `low` to `high`, how it was measured, and where it was published.

    words: of a tissue's name that mean this tissue, between blanks; unless: words that mean another one all the same;
    tumour: whether it is of a tumour, for names that say so alone.
    """

    tissue: str
    words: str
    low: float
    high: float
    method: str
    source: str
    unless: str = ""
    tumour: bool = False

    @property
    def usual_kpa(self) -> float:
        """A Young's modulus (kPa) that the tissue may be given before anything better is known: the geometric mean."""
        return round(math.sqrt(self.low * self.high), 3)

    @property
    def reference(self) -> str:
        """How it was measured and where it was published."""
        return f"{self.method}; {self.source}"


TABLE: dict[str, list[dict[str, Any]]] = tomllib.loads((files("palpate.statement") / "tissues.toml").read_text("utf-8"))
PUBLISHED = tuple(PublishedStiffness(**entry) for entry in TABLE["published"])
TUMOURS = tuple(word for entry in TABLE["role"] if entry.get("tumour") for word in entry["words"].split())


def published_for(name: str) -> tuple[PublishedStiffness, ...]:
    """The published values whose words occur in a tissue's `name`, however it is spelled.

    A tumour has those of tumours of its organ alone, none where the name does not tell the organ.
    """
    tumour = bool(found_word(name, TUMOURS))
    named = [entry for entry in PUBLISHED if entry.tumour is tumour and found_word(name, entry.words.split())]
    return tuple(entry for entry in named if not found_word(name, entry.unless.split()))


def usual_stiffness(name: str) -> PublishedStiffness | None:
    """What was published for a tissue's name in the narrowest range; None when nothing was."""
    return min(published_for(name), key=lambda entry: entry.high / entry.low, default=None)


def plausibility_warnings(moduli_kpa: Mapping[str, float]) -> tuple[Finding, ...]:
    """Warnings on moduli (tissue name -> kPa) far outside what was published, each naming its source.

    A bladder is not compared with its wall: meshed as one solid it has an effective modulus, which none published.
    """
    found = []
    for name, value in moduli_kpa.items():
        walls = bool(found_word(name, ("wall",)))
        entries = [entry for entry in published_for(name) if walls or not entry.tissue.endswith("wall")]
        low, high = min((e.low for e in entries), default=0.0), max((e.high for e in entries), default=math.inf)
        if low / MARGIN <= value <= high * MARGIN:
            continue
        closest = min(entries, key=lambda entry: min(abs(value - entry.low), abs(value - entry.high)))
        text = (
            f"{name}: {value:.3g} kPa lies more than {MARGIN:g} times outside the published"
            f" range for {closest.tissue}, {low:g} to {high:g} kPa ({closest.reference})."
            " Check the modulus of the `known` tissue, the labels and the boundary."
        )
        found.append(Finding("implausible-stiffness", text))
    return tuple(found)


def estimate_warnings(case: Case, estimation: Estimation) -> tuple[Finding, ...]:
    """`plausibility_warnings` on the moduli that a converged estimate states in kPa.

    None where the images give their ratio only or less, and none where the scale in kPa is a guess.
    """
    if estimation.status != "converged" or _scale_is_guessed(case):
        return ()
    stated = [e for e in estimation.estimates if e.verdict not in ("ratio only", NOT_IDENTIFIED)]
    return plausibility_warnings({e.tissue: e.value for e in stated if e.value is not None})


def _scale_is_guessed(case: Case) -> bool:
    """Whether the range of the known modulus that sets the scale is too wide to judge a modulus by.

    That is one whose ends differ by more than `MARGIN`, as the ends of those that `palpate init` fills in do.
    """
    known = [tissue.modulus_sd for tissue in case.tissues if tissue.role is Role.KNOWN]
    return not case.known_force and 2.0 * NORMAL_95 * next(iter(known), 0.0) > math.log(MARGIN)


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
            what = f"'{entries[0].tissue}'" if entries else "soft tissue"
            hints.append(
                Finding(
                    "units",
                    f"tissue '{name}': youngs_modulus_kpa = {value:g} is unusual for {what}, which has {low:g} to"
                    f" {high:g} kPa with room for methods. If you meant {value:g} {unit}, write {value * factor:g}.",
                )
            )
    return tuple(hints)
