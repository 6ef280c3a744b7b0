"""Published tissue stiffness, to ask whether an estimate can be right."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass

from palpate.findings import Finding
from palpate.images.tissue import Role
from palpate.study.case import Case
from palpate.study.estimation import Estimation

__all__ = [
    "PUBLISHED",
    "PublishedStiffness",
    "UsualModulus",
    "estimate_warnings",
    "plausibility_warnings",
    "published_for",
    "unit_warnings",
    "usual_modulus",
]

MARGIN = 3.0  # methods differ by ten to a hundred times: an estimate is doubtful only well outside what was published
SOFT_TISSUE_KPA = (0.05, 1000.0)  # of a tissue for whose name nothing was published, with room on both sides
GIVEN_MARGIN = 10.0  # a modulus that is given lies outside what was published for its name by methods, a slip by 1000


@dataclass(frozen=True, slots=True)
class PublishedStiffness:
    """Young's modulus (kPa) of a tissue from `low` to `high`, how it was measured, and where it was published.

    words: parts of a tissue's name that mean this tissue; unless: parts that mean another one all the same.
    """

    tissue: str
    words: tuple[str, ...]
    low: float
    high: float
    method: str
    source: str
    unless: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class UsualModulus:
    """A Young's modulus (kPa) that a tissue may be given before anything better is known, and where it comes from."""

    kpa: float
    source: str


PUBLISHED = (
    PublishedStiffness(
        "prostate",
        ("prostate", "prostatic", "central_gland", "peripheral_zone", "transition_zone"),
        8.0,
        26.0,
        "indentation ex vivo, 552 sites of 46 glands, without cancer: 17.0 +- 9.0 kPa",
        "Ahn et al., Urology 76 (2010) 1007",
    ),
    PublishedStiffness(
        "prostate",
        ("prostate", "prostatic", "central_gland", "peripheral_zone", "transition_zone"),
        12.9,
        36.7,
        "static palpation in vivo, 12 patients, without cancer: 24.8 (interquartile range 11.9) kPa",
        "doi 10.1177/09544119231154305",
    ),
    PublishedStiffness(
        "prostate",
        ("prostate", "prostatic"),
        660.0,
        660.0,
        "tensile test, cadaver, transverse",
        "Berardo et al.",
    ),
    PublishedStiffness(
        "prostate cancer",
        ("tumour", "tumor", "lesion", "cancer", "carcinoma"),
        9.6,
        38.6,
        "indentation ex vivo, 552 sites of 46 glands: 24.1 +- 14.5 kPa",
        "Ahn et al., Urology 76 (2010) 1007",
    ),
    PublishedStiffness(
        "bladder wall",
        ("bladder",),
        214.0,
        470.0,
        "tensile test of the wall, linear range",
        "Muslov et al. (2025)",
        unless=("gall",),
    ),
    PublishedStiffness(
        "colon and rectum wall",
        ("colon", "rectum", "colorectal", "bowel"),
        1830.0,
        5180.0,
        "tensile test of the wall: pig 1.83 MPa, human 5.18 MPa",
        "doi 10.1186/s40064-015-0922-x",
    ),
    PublishedStiffness(
        "liver",
        ("liver", "hepatic"),
        4.2,
        6.6,
        "shear modulus 1.8 +- 0.4 kPa, E = 3 G",
        "PMC6925591, table 1",
    ),
    PublishedStiffness(
        "fat",
        ("fat", "adipose"),
        2.25,
        2.25,
        "magnetic resonance elastography at 50 Hz: shear modulus 0.75 kPa, E = 3 G",
        "Hatt et al. (2023), doi 10.1016/j.jmbbm.2023.105924",
    ),
    PublishedStiffness(
        "muscle",
        ("muscle", "gluteal", "gluteus", "iliopsoas"),
        3.0,
        3.0,
        "magnetic resonance elastography at 50 Hz: shear modulus 1.0 kPa, E = 3 G",
        "Hatt et al. (2023), doi 10.1016/j.jmbbm.2023.105924",
    ),
    PublishedStiffness(
        "muscle",
        ("muscle", "gluteal", "gluteus", "iliopsoas"),
        1.5,
        282.0,
        "shear wave speed in vivo 0.7 to 9.7 m/s, E = 3 rho c^2 with rho = 1000 kg/m^3",
        "PMC9631468, table 3",
    ),
)


def published_for(name: str) -> tuple[PublishedStiffness, ...]:
    """The published values whose words occur in a tissue's `name`, whatever its case, blanks and hyphens."""
    plain = name.lower().replace(" ", "_").replace("-", "_")
    named = [entry for entry in PUBLISHED if any(word in plain for word in entry.words)]
    found = [entry for entry in named if not any(word in plain for word in entry.unless)]
    tumours = [entry for entry in found if entry.tissue == "prostate cancer"]
    return tuple(tumours or found)


def usual_modulus(name: str) -> UsualModulus | None:
    """The geometric mean of the narrowest published range for a tissue's name; None when nothing was published."""
    entries = published_for(name)
    if not entries:
        return None
    entry = min(entries, key=lambda item: item.high / item.low)
    return UsualModulus(round((entry.low * entry.high) ** 0.5, 3), f"{entry.method}; {entry.source}")


def plausibility_warnings(moduli_kpa: Mapping[str, float]) -> tuple[Finding, ...]:
    """Warnings on moduli (tissue name -> kPa) far outside what was published, each naming its source.

    A bladder is not compared with its wall: meshed as one solid it has an effective modulus, which none published.
    """
    return tuple(warning for name, value in moduli_kpa.items() for warning in _out_of_range(name, value))


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


def _out_of_range(name: str, value: float) -> Iterable[Finding]:
    walls = "wall" in name.lower()
    entries = [entry for entry in published_for(name) if walls or not entry.tissue.endswith("wall")]
    if not entries:
        return
    low, high = min(entry.low for entry in entries), max(entry.high for entry in entries)
    if low / MARGIN <= value <= high * MARGIN:
        return
    closest = min(entries, key=lambda entry: min(abs(value - entry.low), abs(value - entry.high)))
    yield Finding(
        "implausible-stiffness",
        f"{name}: {value:.3g} kPa lies more than {MARGIN:g} times outside the published range for {closest.tissue}"
        f" ({low:g} to {high:g} kPa; nearest: {closest.method}; {closest.source}). Check the `known` tissue's modulus,"
        " the labels and the boundary before you believe it",
    )
