"""What an estimate finds out about itself: ratios only, what is not settled, several minima, folds."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from palpate.findings import Finding
from palpate.images.checks import later_names
from palpate.inversion import Inversion, Outcome
from palpate.mechanics.element import deformation_determinants
from palpate.observation.contract import OfInstrument
from palpate.study.estimated import ModulusEstimate
from palpate.study.together import ImagePairs
from palpate.study.variations import NAMES, Variation, ratio_change
from palpate.uncertainty import FittedState

STRONG_CORRELATION = 0.99
HETEROGENEOUS = 0.01  # probability of such differences between image pairs that have the same moduli
NOISIER, LEAST_IMAGES = 1.6, 3  # times the usual noise of so many later images: one is drawn badly


def inversion_findings(inversion: Inversion, covariance: NDArray[np.float64]) -> tuple[Finding, ...]:
    """What the search itself tells of its result; covariance (n, n) of the parameters."""
    mapping = inversion.objective.parameters
    findings = []
    if not mapping.absolute:
        findings.append(
            Finding(
                "ratio-only",
                f"no tissue's modulus is known, so only ratios to '{mapping.relative_to}' are determined; give one"
                " tissue role `known` with its youngs_modulus_kpa to get kPa",
            )
        )
    if inversion.convergence.unmet:
        findings.append(
            Finding(
                "unsettled",
                f"the iteration ended with what it asks for not met: {'; '.join(inversion.convergence.unmet)};"
                " the model may not fit the images (edge length, driver modes, law), or [noise] should be given",
            )
        )
    if inversion.unsettled:
        findings.append(
            Finding(
                "unsettled",
                f"with the stiffness of layers round organs free the estimate did not end ({inversion.unsettled}), so"
                " that intervals may not hold what a soft or stiff layer would do; another [mesh] edge_length_mm may"
                " help, or [discrepancy] layer_sd = 0 where there is none",
            )
        )
    lost = [c for c in inversion.candidates if c.minimum.outcome is Outcome.NO_EQUILIBRIUM]
    if lost:
        findings.append(
            Finding(
                "no-equilibrium",
                f"{len(lost)} of {len(inversion.candidates)} minima of the linear law have no equilibrium under the"
                " case's law and are not compared with the others; other [estimate] start_ratios show"
                " whether they are minima at all",
            )
        )
    left = sum(c.minimum.outcome is Outcome.NOT_FOLLOWED for c in inversion.candidates)
    unknown = f", but for {left} that could not be followed under the law (log.txt says why)" if left else ""
    if len(inversion.candidates) - len(lost) > 1:
        findings.append(
            Finding(
                "several-minima",
                "the starts ended in different minima; the best fit under one noise model is reported, and the"
                f" intervals reach over all that fit nearly as well{unknown}",
            )
        )
    sd = np.sqrt(np.diag(covariance))
    pairs = np.argwhere(np.tril(np.abs(covariance) > STRONG_CORRELATION * np.outer(sd, sd), -1)).tolist()
    if pairs:
        alike = [f"'{mapping.names[j]}' and '{mapping.names[i]}'" for i, j in pairs]
        what = "the moduli of" if np.max(pairs) < len(mapping.tissues) else "the parameters of"
        text = f"{what} {', of '.join(alike)} cannot be told apart by these images"
        findings.append(Finding("correlated", f"{text}; add some that move them otherwise"))
    return tuple(findings)


def pair_findings(pairs: ImagePairs | None) -> tuple[Finding, ...]:
    """What is told of later images: which the others contradict, which fit worse, whether the rest differ by more."""
    if pairs is None:
        return ()
    findings, several = list[Finding](), len(pairs.alone) >= LEAST_IMAGES
    for name, pair in zip(later_names(len(pairs.alone)), pairs.alone, strict=True):
        for kind, noise in pair.noise_mm.items() if several else ():
            usual = float(np.median([other.noise_mm[kind] for other in pairs.alone if other is not pair]))
            if noise > NOISIER * usual:
                text = f"'{name}' fits worse than the other later images: noise of {noise:.2g} mm beside {usual:.2g} mm"
                advice = f"{text}, so that it counts for less. Look at its labels; it may be left out"
                findings.append(Finding("pair-noise", advice, place=f"in '{name}'"))
        if pair.outlier:
            moved = ", ".join(f"{tissue} by {by:+.1f}" for tissue, by in pair.influence.items())
            mean = ", ".join(f"{tissue} {value:.3g}" for tissue, value in pairs.mean.items())
            text = f"'{name}' contradicts the other later images: it moves the mean of {moved} standard deviations;"
            advice = f"{text} without it the mean is {mean}. Look at its labels, or leave it out"
            findings.append(Finding("pair-outlier", advice, place=f"in '{name}'"))
    if pairs.heterogeneity_p < HETEROGENEOUS:
        text = f"the later images differ by more than their noise (p = {pairs.heterogeneity_p:.1g})"
        advice = f"{text}: read the mean over them, `image_pairs` in result.json, whose interval holds the differences"
        findings.append(Finding("heterogeneous", advice))
    return tuple(findings)


def data_findings(inversion: Inversion) -> tuple[Finding, ...]:
    """A finding for each reading of an instrument whose sign no modulus gives."""
    findings, mapping, unknowns = [], inversion.objective.parameters, inversion.minimum.unknowns
    for line in inversion.minimum.evaluation.linearisations:
        seen = line.observation
        if isinstance(seen, OfInstrument):
            names, offsets = mapping.offset_names(line.state), mapping.offsets(unknowns, line.state)
            offset = dict(zip(names, offsets.tolist(), strict=True)).get(seen.name, 0.0)
            alone = seen.measured + float(line.residuals.values[0]) - offset
            if alone * seen.measured < 0.0:
                text = (
                    f"the {seen.name} was measured as {seen.measured:.3g} {seen.unit}, and the motion needs one of the"
                    f" other sign ({alone:.2g} {seen.unit} at these moduli), so that no modulus explains it: turn its"
                    " direction round. It is positive where it pulls the surface along its direction"
                )
                findings.append(Finding("force-reversed", text, seen.name, place=f"in state {line.state + 1}"))
    return tuple(findings)


def fold_findings(states: Sequence[FittedState]) -> tuple[Finding, ...]:
    """A finding for each later image in which the fitted model turns elements inside out."""
    findings = []
    for name, state in zip(later_names(len(states)), states, strict=True):
        space = state.space
        smallest = deformation_determinants(space, state.displacement).min(axis=1)
        folded = int(np.count_nonzero(smallest <= 0.0))
        if folded:
            worst = space.mesh.nodes[space.mesh.tets[int(smallest.argmin())]].mean(axis=0)
            findings.append(
                Finding(
                    "fold-over",
                    f"'{name}': {folded} of {len(smallest)} elements are turned inside out, the worst near"
                    f" {np.round(worst).astype(int).tolist()} mm (RAS): the motion is too large there for the law or"
                    " the mesh. Look at the labels there, or set a smaller [mesh] edge_length_mm",
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
                text = (
                    "an assumption weighs more than the 95 % interval: state it with the result."
                    f" {label[0].upper()}{label[1:]}, {setting}: {moved}"
                )
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
