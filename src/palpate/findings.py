"""Warnings on images and results: all their codes, from the most harmful to the harmless.

docs/warnings.md explains each code: what it says, what causes it and what to do.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
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
    "segmented-otherwise",
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
    "frame-aligned",
    "added-together",
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

MISLEADING: tuple[str, ...] = get_args(Misleading)  # a modulus can be wrong by more than its interval
WIDENING: tuple[str, ...] = get_args(Widening)  # the interval is right; other images would make it narrower
HARMLESS: tuple[str, ...] = get_args(Harmless)  # the numbers are not affected
CODES = (*MISLEADING, *WIDENING, *HARMLESS)

HELP = "https://github.com/palpate/palpate/blob/main/docs/warnings.md"
MOST_WORDS = 60  # of a warning
ROOM = 10  # words that are left for the name of a pair or image and for other places
SENTENCE_END = re.compile(r"\. (?=[A-Z'])")


@dataclass(frozen=True, slots=True)
class Finding:
    """A warning: a `code` for programs, and a `message` of at most two sentences and 60 words.

    The first sentence says what is wrong and where, the second what to do.
    about: the tissue, say, that the warning is about; place: where it was found, to follow "also" ("in 'after'").
    Findings with one code, about one thing, in several places have one cause.
    """

    code: Code
    message: str
    about: str = ""
    place: str = ""


def one_a_cause(findings: Iterable[Finding]) -> tuple[Finding, ...]:
    """One finding for each cause, the first that was found, with the other places in its message.

    The most harmful one comes first; codes that are unknown here come last.
    """
    causes: dict[tuple[str, ...], list[Finding]] = {}
    for finding in findings:
        key = (finding.code, finding.about) if finding.place else (finding.code, finding.about, finding.message)
        causes.setdefault(key, []).append(finding)
    ranked = sorted(causes.values(), key=lambda same: rank(same[0].code))
    found = []
    for first, *others in ranked:
        places = dict.fromkeys(other.place for other in others if other.place not in ("", first.place))
        found.append(replace(first, message=with_places(first.message, [*places])))
    return tuple(found)


def with_places(message: str, places: Sequence[str]) -> str:
    """The message with other places in its first sentence, as many of them by name as 60 words allow."""
    end = SENTENCE_END.search(message)
    cut = end.start() if end else len(message.removesuffix("."))
    for named in range(len(places), 0, -1):
        text = f"{message[:cut]}; also {some(places, most=named)}{message[cut:]}"
        if words_in(text) <= MOST_WORDS:
            return text
    more = f"; also in {len(places)} more place{'s' * (len(places) > 1)}" if places else ""
    return f"{message[:cut]}{more}{message[cut:]}"


def listing(lead: str, items: Sequence[str], rest: str) -> str:
    """A message of the lead, the items and the rest, with as many items as leave room for the other places."""
    for named in range(len(items), 1, -1):
        text = f"{lead}{some(items, most=named)}{rest}"
        if words_in(text) <= MOST_WORDS - ROOM:
            return text
    return f"{lead}{some(items, most=1)}{rest}"


def some(items: Sequence[str], *, most: int = 3) -> str:
    """The first items, divided by commas, and how many more there are."""
    return ", ".join(items[:most]) + (f" and {len(items) - most} more" if len(items) > most else "")


def words_in(message: str) -> int:
    """Number of words of a message; a quoted name counts as one."""
    return len(re.sub(r"'[^']*'", "name", message).split())


def known_code(code: str) -> Code:
    """The code itself; raises `ValueError` where no warning has it."""
    if code not in CODES:
        raise ValueError(f"no warning has the code {code!r}")
    return cast("Code", code)


def of_pair(findings: Iterable[Finding], number: int) -> tuple[Finding, ...]:
    """The findings on the images of a pair; message and place of those of pair 2 and later name the pair."""
    if number == 1:
        return tuple(findings)
    return tuple(
        replace(each, message=f"Pair {number}: {each.message}", place=each.place and f"{each.place} of pair {number}")
        for each in findings
    )


def warning_rows(findings: Iterable[Finding], *, beside: Iterable[Mapping[str, str]] = ()) -> list[dict[str, str]]:
    """`warnings` of a JSON document: one row for each cause, `beside` the rows that the document already has.

    `help` is the address of the page on the code; a code that is unknown here has none.
    """
    rows = [
        {"code": each.code, "message": each.message} | ({"help": help_on(each.code)} if each.code in CODES else {})
        for each in one_a_cause(findings)
    ]
    return sorted([*map(dict, beside), *rows], key=lambda row: rank(row["code"]))


def help_on(code: str) -> str:
    """Address of the page on warnings, at the section on this code where there is one."""
    return f"{HELP}#{code}" if code in CODES else HELP


def rank(code: str) -> int:
    """The place of a code among all, from 0 for the most harmful; an unknown code comes last."""
    return CODES.index(code) if code in CODES else len(CODES)
