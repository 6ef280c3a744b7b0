"""Warnings that come from the estimate itself: ratios only, not converged, several minima, folded elements."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from palpate.findings import Finding, listing
from palpate.images.checks import later_names
from palpate.inversion import Inversion
from palpate.mechanics.element import deformation_determinants
from palpate.observation.contract import OfInstrument
from palpate.statement.estimation import ModulusEstimate
from palpate.statement.image_pairs import ImagePairs
from palpate.statement.variations import NAMES, Variation, ratio_change
from palpate.uncertainty import FittedState

STRONG_CORRELATION = 0.99
HETEROGENEOUS = 0.01  # probability of such differences between image pairs that have the same moduli
SEVERAL = 0.05  # probability of a further minimum that is told
NOISIER, LEAST_IMAGES = 1.6, 3  # times the usual noise of so many later images: one is drawn badly


def inversion_findings(inversion: Inversion, covariance: NDArray[np.float64]) -> tuple[Finding, ...]:
    """Findings on the search and its result; covariance (n, n) of the parameters."""
    mapping = inversion.objective.parameters
    findings = []
    if not mapping.absolute:
        findings.append(
            Finding(
                "ratio-only",
                f"No modulus and no load is known, so only ratios to '{mapping.relative_to}' are determined. To get"
                " kPa, give one tissue the role known with its youngs_modulus_kpa, or state a load.",
            )
        )
    if not inversion.minimum.converged:
        findings.append(
            Finding(
                "unsettled",
                f"The search ended before it converged: {inversion.minimum.outcome.value}. The model may not fit the"
                " data: try a smaller mesh.edge_length_mm, another law, or [noise].",
            )
        )
    several = Counter(tuple(sorted(of.chosen.items())) for of in inversion.mixture.explanations if of.weight > SEVERAL)
    if max(several.values(), default=0) > 1:
        findings.append(
            Finding(
                "several-minima",
                "The starts of the search ended in different minima that explain the images about as well; the interval"
                " covers them. Look at starts in result.json; use a pair with a larger motion.",
            )
        )
    sd = np.sqrt(np.diag(covariance))
    pairs = np.argwhere(np.tril(np.abs(covariance) > STRONG_CORRELATION * np.outer(sd, sd), -1)).tolist()
    if pairs:
        both = [f"'{mapping.tissues[j]}' and '{mapping.tissues[i]}'" for i, j in pairs]
        rest = ". Add images in which they move differently, or join them."
        text = listing("These data cannot separate the moduli of ", both, rest)
        findings.append(Finding("correlated", text))
    return tuple(findings)


def pair_findings(pairs: ImagePairs | None, names: Sequence[str] = ()) -> tuple[Finding, ...]:
    """Findings on several later images: outliers, images that fit worse, and differences beyond their noise."""
    if pairs is None:
        return ()
    findings, several = list[Finding](), len(pairs.alone) >= LEAST_IMAGES
    for name, pair in zip(names or later_names(len(pairs.alone)), pairs.alone, strict=True):
        for kind, noise in pair.noise_mm.items() if several else ():
            usual = float(np.median([other.noise_mm[kind] for other in pairs.alone if other is not pair]))
            if noise > NOISIER * usual:
                text = (
                    f"'{name}' fits worse than the other later images, with noise of {noise:.2g} mm instead of"
                    f" {usual:.2g} mm, so it has less weight. Check its labels, or leave it out."
                )
                findings.append(Finding("pair-noise", text, kind, f"'{name}' ({noise:.2g} mm)"))
        if pair.outlier:
            moved = [
                f"'{tissue}' by {by:+.1f} standard deviations ({pairs.mean[tissue]:.3g} without it)"
                for tissue, by in pair.influence.items()
            ]
            lead = f"'{name}' contradicts the other later images, and changes the mean modulus of "
            text = listing(lead, moved, ". Check its labels, or leave it out.")
            findings.append(Finding("pair-outlier", text, place=f"'{name}'"))
    if pairs.heterogeneity_p < HETEROGENEOUS:
        text = (
            f"The later images differ by more than their noise (p = {pairs.heterogeneity_p:.1g}), which the joint"
            " interval does not cover. Use the mean in image_pairs of result.json, whose interval does."
        )
        findings.append(Finding("heterogeneous", text))
    return tuple(findings)


def data_findings(inversion: Inversion) -> tuple[Finding, ...]:
    """A finding for each measured force of a sign that no modulus explains."""
    findings, mapping, unknowns = [], inversion.objective.parameters, inversion.minimum.unknowns
    for line in inversion.minimum.evaluation.linearisations:
        seen = line.observation
        if isinstance(seen, OfInstrument):
            names, offsets = mapping.offset_names(line.state), mapping.offsets(unknowns, line.state)
            offset = dict(zip(names, offsets.tolist(), strict=False)).get(seen.name, 0.0)
            alone = seen.measured + float(line.residuals.values[0]) - offset
            if alone * seen.measured < 0.0:
                text = (
                    f"The {seen.name} was measured as {seen.measured:.3g} {seen.unit}, but the motion needs the"
                    f" opposite sign ({alone:.2g} {seen.unit}), so no modulus explains it. Reverse its direction: a"
                    " force is positive where it pulls the surface along its direction."
                )
                findings.append(Finding("force-reversed", text, seen.name, place=f"in state {line.state + 1}"))
    return tuple(findings)


def fold_findings(states: Sequence[FittedState], names: Sequence[str]) -> tuple[Finding, ...]:
    """A finding for each later image in which the fitted motion turns elements inside out."""
    findings = []
    for name, state in zip(names, states, strict=True):
        space = state.space
        smallest = deformation_determinants(space, state.displacement).min(axis=1)
        folded = int(np.count_nonzero(smallest <= 0.0))
        if folded:
            worst = space.mesh.nodes[space.mesh.tets[int(smallest.argmin())]].mean(axis=0)
            findings.append(
                Finding(
                    "fold-over",
                    f"The motion to '{name}' turns {folded} of {len(smallest)} elements inside out, the worst near"
                    f" {np.round(worst).astype(int).tolist()} mm (RAS). Check the data there, try a smaller"
                    " mesh.edge_length_mm or a law at finite strain.",
                    place=f"in '{name}' ({folded})",
                )
            )
    return tuple(findings)


def variation_findings(variations: Sequence[Variation], estimates: Sequence[ModulusEstimate]) -> tuple[Finding, ...]:
    """A finding for each assumption that takes a modulus out of its 95 % interval, with the farthest of its settings.

    What is known as a ratio alone is compared as a ratio.
    """
    findings = []
    for cause, subject in dict.fromkeys((variation.cause, variation.subject) for variation in variations):
        label = NAMES.get(cause, cause).format(subject)
        settings = [v for v in variations if (v.cause, v.subject) == (cause, subject)]
        for of in estimates:
            if words := _farthest_outside(settings, of):
                setting, moved = words
                text = f"{label[0].upper()}{label[1:]}, {setting}: {moved}. State this assumption with the result."
                findings.append(Finding("beyond-interval", text, about=label, place=moved))
    return tuple(findings)


def _farthest_outside(settings: Sequence[Variation], of: ModulusEstimate) -> tuple[str, str] | None:
    """Setting that moves a modulus farthest out of its interval, and where to, in words; None where none does."""
    in_kpa = of.value is not None and of.verdict != "ratio only"
    value, interval = (of.value, of.interval95) if in_kpa else (of.ratio, of.ratio_interval95)
    if not value or interval is None:
        return None
    found, farthest = None, 0.0
    for each in settings:
        change = (each.changes or {}).get(of.tissue, 0.0)
        if not in_kpa:
            change = ratio_change(change, each.cause, each.subject, each.setting, relative_to=of.relative_to)
        end = interval[0 if change < 0.0 else 1]
        outside = 0.0 if end is None else abs(change) - abs(float(np.log(end / value)))
        if outside > farthest:
            ends = " to ".join("open" if end is None else f"{end:.3g}" for end in interval)
            unit = "kPa" if in_kpa else f"x {of.relative_to}"
            moved = f"'{of.tissue}' would have {value * np.exp(change):.3g} {unit}, outside {ends}"
            found, farthest = (each.setting, moved), outside
    return found
