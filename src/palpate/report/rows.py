"""What came out, ready to be set: the banner in plain words, numbers and sentences of tables."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from palpate.report.ticks import log_marks, mark_text
from palpate.report.units import ModulusUnit, shown_unit
from palpate.uncertainty import EARLIER, NORMAL_95, Interval
from palpate.unknowns import FIELD, KNOWN_MODULUS, PATCHINESS

NONE = "–"
BELIEVED = "what was believed before"
BAR = 200.0  # width of a bar, in its own units
CAUSES = {
    "noise": "the surfaces' noise",
    "driver": "the drivers' motion",
    "frame": "the frame's motion",
    "offset": "how surfaces are drawn",
    "reference": "how the reference image is drawn",
    "heterogeneity": "tissues that are not homogeneous",
    FIELD: "what is mapped",
    "layer": "layers round the organs",
    "poisson": "Poisson's ratios",
    "instrument": "the instruments' offsets",
    KNOWN_MODULUS: "the range of the known modulus",
    EARLIER: "what earlier images left open",
    "minima": "several minima",
    "prior": "what is believed of parameters",
    "grid": "the voxels' place",
    "mesh": "the mesh",
}
SCENARIOS = {
    **{level: f"{level} tissues" for level in PATCHINESS},
    "bonded": "no layers round organs",
    "layers": "layers round organs",
}
MOST_CAUSES = 4  # of a bar; the smaller ones together are the last
OTHERS = "others"
FADING = 0.6  # of a cause's opacity, that of the next one on the bar
FOUND = {
    "identified": "The images fix the stiffness of {}.",
    "weak": "The stiffness of {} is uncertain: use the interval, not only the number.",
    "ratio only": "The images fix the stiffness of {} only as a ratio, not in kilopascals.",
}
MISSED = "The fitted model misses some of the data by more than their errors. The interval does not cover this."
OPEN = "The images do not fix the stiffness of {}: do not use {}."


@dataclass(frozen=True, slots=True)
class Bar:
    """Places of interval, value and truth on a common logarithmic scale from 0 to BAR; None: open or not there."""

    low: float
    high: float
    value: float | None
    truth: float | None
    open_low: bool
    open_high: bool


@dataclass(frozen=True, slots=True)
class Share:
    """A part of a whole by its cause, as text, and its place and width on a bar from 0 to BAR, with an opacity."""

    cause: str
    percent: str
    place: float
    width: float
    opacity: float


@dataclass(frozen=True, slots=True)
class EstimateRow:
    """One tissue of the result table, all texts; shares: of the largest causes in the variance of ln E, and the rest.

    shown, shown_interval, shown_in: the number that leads, its interval and its unit, which is the page's; also: the
    same otherwise, as a sentence. causes: all shares, where `shares` joins some; sources: of each kind of data in what
    is known of it, where a case has more than images. value, interval, unit: those of the document; reference: the
    modulus of `relative_to`, kPa; truth: with its unit; expected: how often an error as large as that from the truth
    comes about, by the interval.
    """

    tissue: str
    colour: str
    shown: str
    shown_interval: str
    shown_in: str
    also: str
    value: str
    interval: str
    unit: str
    ratio: str
    ratio_interval: str
    relative_to: str
    reference: str
    verdict: str
    why: str
    truth: str
    error: str
    expected: str
    bar: Bar | None
    shares: tuple[Share, ...]
    causes: str
    sources: tuple[Share, ...]


@dataclass(frozen=True, slots=True)
class RatioRow:
    """A Poisson's ratio as a table shows it: value, 95 % interval, verdict and why, as texts."""

    tissue: str
    value: str
    interval: str
    verdict: str
    why: str


@dataclass(frozen=True, slots=True)
class ExplanationRow:
    """One explanation of the later images, as texts: its probability, what is so of all of them, and moduli by tissue.

    images: those that show more, by name, which is empty where there is only one.
    """

    probability: str
    scenario: str
    images: tuple[tuple[str, str], ...]
    moduli: tuple[tuple[str, str], ...]


def number(value: float | None, *, digits: int = 3) -> str:
    """`value` with so many significant digits, without exponent where it can be read; a dash for nothing."""
    if value is None or not math.isfinite(value):
        return NONE
    if value == 0.0:
        return "0"
    magnitude = int(f"{value:.{digits - 1}e}".partition("e")[2])  # of what is left after rounding
    if not -4 <= magnitude < 7:
        return f"{value:.{digits - 1}e}"
    return f"{round(value, digits - 1 - magnitude):.{max(digits - 1 - magnitude, 0)}f}"


def moduli_in(document: Mapping[str, Any]) -> list[dict[str, Any]]:
    """The entries of a result document's "estimates" that are Young's moduli; they come first."""
    return [item for item in document["estimates"] if item["parameter"] == "youngs_modulus"]


def ratio_rows(document: Mapping[str, Any]) -> tuple[RatioRow, ...]:
    """A row for each Poisson's ratio that was sought; nothing that did not converge shows a number."""
    shown = document["status"] == "converged"
    return tuple(
        RatioRow(
            item["tissue"],
            number(item["value"] if shown else None),
            interval_text(item["interval95"] if shown else None),
            item["verdict"] if shown else "not identified",
            item["why"],
        )
        for item in document["estimates"]
        if item["parameter"] == "poisson_ratio"
    )


def explanation_rows(document: Mapping[str, Any]) -> tuple[ExplanationRow, ...]:
    """A row for each explanation of a result document, with moduli in the unit that is shown."""
    unit = shown_unit(document)
    return tuple(
        ExplanationRow(
            _percent(of["probability"]),
            listed([SCENARIOS.get(word, word) for word in of["scenario"]]) or NONE,
            tuple(
                (image["after"] if len(of["images"]) > 1 else "", listed(image["shows"]))
                for image in of["images"]
                if image["shows"]
            ),
            tuple((tissue, number(unit.of_document(value))) for tissue, value in of["moduli"].items()),
        )
        for of in document.get("explanations", ())
    )


def estimate_rows(document: Mapping[str, Any], colours: Mapping[str, str]) -> tuple[EstimateRow, ...]:
    """A row for each modulus of a result document; nothing that did not converge shows a number.

    `colours`: tissue -> #rrggbb.
    """
    items, unit = moduli_in(document), shown_unit(document)
    found = document["status"] == "converged"
    scale = _scale(items, unit) if found else None
    rows = []
    for item in items:
        value, interval = unit.numbers(item) if found else (None, None)
        truth, shares = unit.truth(item), _causes(item, unit) if found else {}
        sources = document.get("information_shares", {}).get(item["tissue"], {}) if document["case"].get("data") else {}
        largest = sorted(sources.items(), key=lambda source: -source[1])
        row = EstimateRow(
            tissue=item["tissue"],
            colour=colours.get(item["tissue"], "#888888"),
            shown=number(value),
            shown_interval=interval_text(interval),
            shown_in=unit.text,
            also=_also(item, unit) if found else "",
            value=number(item["value"] if found else None),
            interval=interval_text(item["interval95"] if found else None),
            unit=item["unit"],
            ratio=number(item["ratio"] if found else None),
            ratio_interval=interval_text(item["ratio_interval95"] if found else None),
            relative_to=item["relative_to"],
            reference=number(item["value"] / item["ratio"] if found and item["value"] and item["ratio"] else None),
            verdict=item["verdict"] if found else "not identified",
            why=item["why"],
            truth=_truth(item, truth, unit),
            error=f"{100.0 * (value / truth - 1.0):+.1f} %" if value and truth else NONE,
            expected=expected_share(value, interval, truth) if value and truth else NONE,
            bar=_bar(value, interval, truth=truth, scale=scale) if scale and value and interval else None,
            shares=_shares(_largest(shares)),
            causes=listed([f"{cause} {_percent(share)}" for cause, share in shares.items()])
            if len(shares) > MOST_CAUSES
            else "",
            sources=_shares({BELIEVED if kind == "prior" else kind: share for kind, share in largest}) if found else (),
        )
        rows.append(row)
    return tuple(rows)


def _also(item: Mapping[str, Any], unit: ModulusUnit) -> str:
    """The number of a row in the unit that does not lead, as a sentence; in kPa it says of which known modulus."""
    value, ratio, to = item["value"], item["ratio"], item["relative_to"]
    if value is None or ratio is None:
        return ""
    ends = interval_text(item["interval95"])
    if unit.name == "kPa":
        between = interval_text(item["ratio_interval95"])
        return f"{number(ratio)} × {to}{f' ({between})' if between != NONE else ''}"
    if item["verdict"] != "ratio only":
        return f"{number(value)} kPa{f' ({ends})' if ends != NONE else ''}"
    return (
        f"{number(value)} kPa if {to} has {number(value / ratio)} kPa. The modulus of {to} is known only within a"
        f" range; over that range {ends} kPa"
    )


def _truth(item: Mapping[str, Any], truth: float | None, unit: ModulusUnit) -> str:
    """The true modulus with its unit: the one that is shown, else kPa."""
    if item["truth"] is None:
        return NONE
    return f"{number(item['truth'])} kPa" if truth is None else f"{number(truth)} {unit.text}"


def _causes(item: Mapping[str, Any], unit: ModulusUnit) -> dict[str, float]:
    """Share of each cause in the variance of what is shown, the largest first; of ratios without the known modulus."""
    shares = dict[str, float](item.get("variance_shares") or {})
    if unit.name == "ratio":
        shares.pop(KNOWN_MODULUS, None)
    whole = sum(shares.values()) or 1.0
    ranked = sorted(shares.items(), key=lambda share: -share[1])
    return {str(CAUSES.get(cause, cause)): share / whole for cause, share in ranked}


def _largest(shares: Mapping[str, float]) -> dict[str, float]:
    """The largest shares, and the rest of more than `MOST_CAUSES` as one."""
    if len(shares) <= MOST_CAUSES:
        return dict(shares)
    ranked = list(shares.items())
    return dict(ranked[: MOST_CAUSES - 1]) | {OTHERS: sum(share for _, share in ranked[MOST_CAUSES - 1 :])}


def expected_share(value: float, interval: Interval | None, truth: float) -> str:
    """How often an estimate lies as far from the truth as this one, "40 %", by its 95 % interval; a dash without one.

    2 (1 - Phi(|ln E / E_0| / s)), s the interval's half-width of ln E on the side of the truth, over 1.96.
    """
    end = None if interval is None else interval[0 if truth < value else 1]
    if not end or end == value:
        return NONE
    return (
        f"{100.0 * math.erfc(abs(NORMAL_95 * math.log(value / truth) / math.log(value / end)) / math.sqrt(2.0)):.0f} %"
    )


def scale_marks(document: Mapping[str, Any]) -> tuple[tuple[float, str], ...]:
    """Places (0 to BAR) and labels of round numbers on the common scale of the bars."""
    scale = _scale(moduli_in(document), shown_unit(document)) if document["status"] == "converged" else None
    if scale is None:
        return ()
    room = 0.04 * (scale[1] - scale[0])
    marks = log_marks(math.exp(scale[0] + room), math.exp(scale[1] - room), most=6)
    return tuple((BAR * (math.log(n) - scale[0]) / (scale[1] - scale[0]), mark_text(n)) for n in marks)


def interval_text(interval: Interval | None) -> str:
    """As "2.00 to 5.00"; "> 2.00" or "< 5.00" with one end open, "any" with both; a dash for nothing."""
    if interval is None:
        return NONE
    low, high = interval
    if low is None and high is None:
        return "any"
    if low is None:
        return f"< {number(high)}"
    return f"> {number(low)}" if high is None else f"{number(low)} to {number(high)}"


def _scale(items: Iterable[Mapping[str, Any]], unit: ModulusUnit) -> tuple[float, float] | None:
    """Natural logarithms of the smallest and the largest number to be shown, with room on both sides."""
    numbers: list[float] = []
    for item in items:
        value, interval = unit.numbers(item)
        numbers += [n for n in (value, unit.truth(item), *(interval or ())) if n is not None and n > 0.0]
    if not numbers:
        return None
    low, high = math.log(min(numbers)), math.log(max(numbers))
    room = 0.08 * (high - low) + 0.1
    return low - room, high + room


def _percent(share: float) -> str:
    """A share of 1 in per cent; one that rounds to nothing is not said to be nothing."""
    return "under 1 %" if 0.0 < share < 0.005 else f"{100.0 * share:.0f} %"


def _shares(parts: Mapping[str, float]) -> tuple[Share, ...]:
    """Parts of 1 by their names, one after the other along a bar."""
    found, place = list[Share](), 0.0
    for number, (name, part) in enumerate(parts.items()):
        found.append(Share(name, _percent(part), place, BAR * part, round(FADING**number, 2)))
        place += BAR * part
    return tuple(found)


def _bar(value: float, interval: Interval, *, truth: float | None, scale: tuple[float, float]) -> Bar:
    def place(number: float | None, otherwise: float) -> float:
        """Where a number lies along the bar; `otherwise` for an open end or a value that has no logarithm."""
        return BAR * (math.log(number) - scale[0]) / (scale[1] - scale[0]) if number and number > 0 else otherwise

    low, high = interval
    return Bar(
        low=place(low, 0.0),
        high=place(high, BAR),
        value=place(value, 0.0),
        truth=None if truth is None else place(truth, 0.0),
        open_low=low is None,
        open_high=high is None,
    )


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
    sentences += [MISSED] * any(warning["code"] == "data-misfit" for warning in document["warnings"])
    sentences += _of_starts([start["minimum"] for start in document["starts"]])
    if lost := verdicts.get("not identified"):
        title = OPEN.format(listed(lost), "its number" if len(lost) == 1 else "their numbers")
        return Headline("bad", title, tuple(sentences), warnings, reason)
    good = set(verdicts) <= {"identified", "ratio only"} and not count
    return Headline("good" if good else "fair", "A result was found.", tuple(sentences), warnings, reason)


def _of_starts(minima: Sequence[int | None]) -> list[str]:
    """Where the starts led, by the number of each one's minimum, None where it was not followed; nothing of one."""
    n, led = len(minima), [minimum for minimum in minima if minimum is not None]
    if n < 2:
        return []
    if (answers := len(set(led))) > 1:
        return [f"The search from {n} starts led to {answers} different answers; the result weighs them."]
    if len(led) == n:
        return [f"The search led to the same answer from all {n} starts."]
    return [f"The search led to an answer from {len(led)} of {n} starts; the others stopped, or fitted worse."]


def listed(names: Sequence[str]) -> str:
    """Names as in a sentence: "a, b and c"."""
    return " and ".join(filter(None, (", ".join(names[:-1]), *names[-1:])))
