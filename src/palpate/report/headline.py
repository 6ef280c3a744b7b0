"""What came out, in words for a reader who knows neither the method nor the program."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from palpate.report.rows import moduli_in

__all__ = ["Headline", "headline", "listed"]

FOUND = {
    "identified": "The images fix the stiffness of {}.",
    "weak": "The images say little about the stiffness of {}: use the interval, not the number alone.",
    "ratio only": "The images fix the stiffness of {} as a ratio to the others, not as a number of kilopascals.",
}
OPEN = "The images do not fix the stiffness of {}: do not use {}."


@dataclass(frozen=True, slots=True)
class Headline:
    """The banner: `kind` "good", "fair" or "bad", title, sentences, number of warnings, and the search's own reason."""

    kind: str
    title: str
    sentences: tuple[str, ...]
    warnings: str
    own_words: str


def headline(document: Mapping[str, Any]) -> Headline:
    """The banner of a result document."""
    count, reason = len(document["warnings"]), str(document["reason"])
    warnings = "No warnings." if not count else "1 warning" if count == 1 else f"{count} warnings"
    if document["status"] != "converged":
        why = "the search for the stiffness did not come to an end" if document["status"] == "not converged" else ""
        return Headline("bad", f"There is no result{f': {why}' if why else ''}.", (reason,), warnings, "")
    verdicts: dict[str, list[str]] = {}
    for item in moduli_in(document):
        verdicts.setdefault(item["verdict"], []).append(item["tissue"])
    sentences = [FOUND[verdict].format(listed(verdicts[verdict])) for verdict in FOUND if verdict in verdicts]
    starts = document["starts"]
    if len(starts) > 1:
        answers = len({start["minimum"] for start in starts if start["minimum"] is not None})
        several = f"The search from {len(starts)} starts led to {answers} different answers; the best one is shown."
        same = f"The search led to the same answer from all {len(starts)} starts."
        sentences.append(several if answers > 1 else same)
    if lost := verdicts.get("not identified"):
        title = OPEN.format(listed(lost), "its number" if len(lost) == 1 else "their numbers")
        return Headline("bad", title, tuple(sentences), warnings, reason)
    good = set(verdicts) <= {"identified", "ratio only"} and not count
    return Headline("good" if good else "fair", "A result was found.", tuple(sentences), warnings, reason)


def listed(names: Sequence[str]) -> str:
    """Names as in a sentence: "a, b and c"."""
    return " and ".join(filter(None, (", ".join(names[:-1]), *names[-1:])))
