"""What the user should know of images and results: every warning there is, ordered by what it costs in the answer.

The codes stand here once. What each says, where it comes from and what to do is told in docs/warnings.md.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from typing import Literal, cast, get_args

Misleading = Literal[
    "mirrored",
    "frame-moves",
    "voxel-size",
    "spacing-nearly-same",
    "half-voxel",
    "large-shift",
    "volume-implausible",
    "fold-over",
    "pair-outlier",
    "pair-noise",
    "implausible-stiffness",
    "units",
    "linear-strains",
    "weightless-reference",
    "volume-change",
    "relaxed-state",
    "void-moves",
    "drawn-otherwise",
    "layer",
    "several-bodies",
    "open-contours",
    "overlap",
    "heterogeneous",
    "unsettled",
    "too-small",
    "thin",
    "islands",
    "sparse-contours",
    "cropped",
    "scaled-labels",
    "rotation-undetermined",
    "rigid-unseen",
    "points-outside",
    "data-misfit",
    "force-reversed",
    "no-equilibrium",
    "beyond-interval",
]
Widening = Literal[
    "ratio-only",
    "map-of-prior",
    "points-unpaired",
    "motion-below-noise",
    "correlated",
    "several-minima",
    "little-in-common",
    "cut-by-border",
    "touching",
]
Harmless = Literal[
    "samples-not-mixed",
    "frame-aligned",
    "finer-mesh",
    "front-exchanged",
    "sides-exchanged",
    "memory",
    "memory-now",
    "report",
    "case-file",
    "names-left-out",
    "earlier-files",
]
Code = Misleading | Widening | Harmless

MISLEADING: tuple[str, ...] = get_args(Misleading)  # can move a modulus by more than its interval
WIDENING: tuple[str, ...] = get_args(Widening)  # less is found than other images would show
HARMLESS: tuple[str, ...] = get_args(Harmless)  # the numbers are as good as without
CODES = (*MISLEADING, *WIDENING, *HARMLESS)


@dataclass(frozen=True, slots=True)
class Finding:
    """Something the user should know: `code` for programs, `message` a sentence with advice.

    about: the tissue, say, that it is about; place: where it was seen, in words that go on after "also" ("in 'after'").
    Findings of one code about one thing in several places have one cause.
    """

    code: Code
    message: str
    about: str = ""
    place: str = ""


def one_a_cause(findings: Iterable[Finding]) -> tuple[Finding, ...]:
    """One finding a cause, the one found first, which names the other places; what costs most in the answer is first.

    Codes of other programs' readers come last.
    """
    causes: dict[tuple[str, ...], list[Finding]] = {}
    for finding in findings:
        key = (finding.code, finding.about) if finding.place else (finding.code, finding.about, finding.message)
        places = causes.setdefault(key, [])
        if finding not in places:
            places.append(finding)
    ranked = sorted(causes.values(), key=lambda places: rank(places[0].code))
    found = []
    for first, *others in ranked:
        also = ", ".join(other.place for other in others if other.place)
        found.append(replace(first, message=f"{first.message}; also {also}") if also else first)
    return tuple(found)


def known_code(code: str) -> Code:
    """The code itself; raises `ValueError` where no warning has it."""
    if code not in CODES:
        raise ValueError(f"no warning has the code {code!r}")
    return cast("Code", code)


def of_pair(findings: Iterable[Finding], number: int) -> tuple[Finding, ...]:
    """The findings on the images of a pair; from the second on, number 2, they say so."""
    if number == 1:
        return tuple(findings)
    said = "pair {}: {}"
    return tuple(
        replace(each, message=said.format(number, each.message), place=each.place and said.format(number, each.place))
        for each in findings
    )


def warning_rows(findings: Iterable[Finding], *, beside: Iterable[Mapping[str, str]] = ()) -> list[dict[str, str]]:
    """`warnings` of a JSON document, one a cause; `beside`: those that it has already."""
    rows = [{"code": finding.code, "message": finding.message} for finding in one_a_cause(findings)]
    return sorted([*map(dict, beside), *rows], key=lambda row: rank(row["code"]))


def rank(code: str) -> int:
    """The place of a code among all, from 0: what costs more in the answer is lower; an unknown one is last."""
    return CODES.index(code) if code in CODES else len(CODES)
