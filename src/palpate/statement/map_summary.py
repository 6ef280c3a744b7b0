"""A map of stiffness in words: a part differs, no part differs, or the data cannot tell."""

from __future__ import annotations

from collections.abc import Sequence

from palpate.findings import Finding
from palpate.uncertainty import CONTRAST, StiffnessMap

RESOLVED = 0.5  # share of the prior's variance that data must remove for a map to be theirs


def map_summary(of: StiffnessMap) -> str:
    """One sentence, or two, on a map."""
    region = of.region
    if region is None:
        if of.resolved < RESOLVED:
            return (
                f"The data cannot tell whether a part of '{of.tissue}' differs: they removed {of.resolved:.0%} of the"
                " variance of ln E inside it. Use the tissue's mean."
            )
        return (
            f"No part of '{of.tissue}' is likely to be more than {CONTRAST:g} times stiffer or softer than the tissue"
            f" ({of.resolved:.0%} of the variance of ln E inside it is resolved)."
        )
    low, high = region.interval95
    place = ", ".join(f"{x:.0f}" for x in region.centre_mm)
    return (
        f"A part of '{of.tissue}' differs: {region.volume_ml:.2g} mL about ({place}) mm; its core is"
        f" {region.contrast:.2g} times as stiff as the rest of the tissue ({low or 0.0:.2g} to {high or 0.0:.2g}, 95 %"
        f"). That a place in it is more than {CONTRAST:g} times {'stiffer' if region.contrast > 1.0 else 'softer'} than"
        f" the tissue has a probability of up to {100.0 * region.probability:.3g} %."
    )


def map_findings(maps: Sequence[StiffnessMap]) -> tuple[Finding, ...]:
    """A finding for every map that shows the prior rather than the data."""
    return tuple(
        Finding(
            "map-of-prior",
            f"The map of '{of.tissue}' shows mostly the prior: the data removed only {of.resolved:.0%} of the prior's"
            " variance of ln E inside it. Use the tissue's mean, or give a displacement field ([[data]]).",
        )
        for of in maps
        if of.resolved < RESOLVED
    )
