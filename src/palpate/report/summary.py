"""The half page at the top for a reader who is no engineer: what was found, how sure it is, what not to do with it."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from palpate.findings import HARMLESS, WIDENING
from palpate.report.rows import listed, moduli_in, number
from palpate.report.units import ModulusUnit, shown_unit
from palpate.uncertainty import Interval

RESEARCH = (
    "Do not base a diagnosis or a treatment on this page: Palpate is a research program and not a medical device."
)
PASCAL = (
    "Stiffness is given in kilopascals (kPa): twice the number means that the same push moves the tissue half as far."
)
NO_SCALE = "The images show only how stiff the tissues are compared with each other, so each number is a ratio."


@dataclass(frozen=True, slots=True)
class Summary:
    """Sentences: what was found, a list of what was found by tissue, how sure that is, and what not to do with it."""

    lead: tuple[str, ...]
    found: tuple[tuple[str, str], ...]
    sure: tuple[str, ...]
    avoid: tuple[str, ...]


def summary(document: Mapping[str, Any]) -> Summary:
    """The summary of a document result.json, in the words and the unit that its verdicts allow."""
    tissues = [item["tissue"] for item in moduli_in(document)]
    if document["status"] != "converged":
        why = "did not find a stable answer" if document["status"] == "not converged" else "could not be completed"
        return Summary(
            (f"There is no result. The estimate of the stiffness of {listed(tissues)} {why}.",),
            (),
            (
                "Nothing can be said about how stiff these tissues are.",
                "The coloured box above gives the reason.",
            ),
            ("Do not use any number or picture of this page as a result.", RESEARCH),
        )
    unit = shown_unit(document)
    return Summary(
        (
            "Palpate compared states of one body. It sought the stiffness that best explains their difference.",
            PASCAL if unit.name == "kPa" else NO_SCALE,
        ),
        tuple((item["tissue"], _found(item, unit)) for item in moduli_in(document)),
        tuple(_sure(document, unit)),
        tuple(_avoid(document, unit)),
    )


def _found(item: Mapping[str, Any], unit: ModulusUnit) -> str:
    """What was found of one tissue."""
    value, interval = unit.numbers(item)
    if item["verdict"] == "not identified" or value is None:
        return "no answer. The images do not show how stiff it is."
    about = f"{number(value, digits=2)} {_after(unit)}"
    about = f"uncertain, roughly {about}" if item["verdict"] == "weak" else f"about {about}"
    if unit.name == "ratio" and item["verdict"] == "identified" and item["value"] is not None:
        about += f" (about {number(item['value'], digits=2)} kPa)"
    what = "value" if unit.name == "kPa" else "ratio"
    return f"{about}. {_between(interval, f'The true {what} probably lies')}{'.' if interval else ''}"


def _after(unit: ModulusUnit) -> str:
    return "kPa" if unit.name == "kPa" else f"times as stiff as {unit.relative_to}"


def _between(interval: Interval | None, words: str) -> str:
    """What an interval says, without a number that is not there."""
    if interval is None:
        return ""
    low, high = interval
    ends = [None if end is None else number(end, digits=2) for end in (low, high)]
    if ends[0] is None or ends[1] is None:
        return f"{words} {f'below {ends[1]}' if ends[1] else f'above {ends[0]}' if ends[0] else 'anywhere'}"
    return f"{words} between {ends[0]} and {ends[1]}"


def _by_verdict(document: Mapping[str, Any]) -> dict[str, list[str]]:
    """The tissues of each verdict."""
    found: dict[str, list[str]] = {}
    for item in moduli_in(document):
        found.setdefault(item["verdict"], []).append(item["tissue"])
    return found


def _sure(document: Mapping[str, Any], unit: ModulusUnit) -> Iterator[str]:
    """How sure the numbers are."""
    of = _by_verdict(document)
    if good := of.get("identified"):
        whose = "its range" if len(good) == 1 else "each of these ranges"
        yield (
            f"The images fix the stiffness of {listed(good)}. The highest value of {whose} is at most four times the"
            " lowest."
        )
    if ratios := of.get("ratio only"):
        yield f"The images fix the stiffness of {listed(ratios)} only in comparison with {unit.relative_to}."
    if weak := of.get("weak"):
        yield f"The stiffness of {listed(weak)} is uncertain: use the range, not the single number."
    if lost := of.get("not identified"):
        yield f"The images do not fix the stiffness of {listed(lost)}. It may be high, low or normal."
    if of.keys() - {"not identified"}:
        yield (
            "'Probably' means: about 95 of 100 such ranges contain the true value (95 % interval). This holds only if"
            " the model's assumptions are right."
        )
    codes = {str(warning["code"]) for warning in document["warnings"]}
    if "data-misfit" in codes:
        yield "The model does not explain all of the data. The true stiffness may lie outside its range."
    if grave := [code for code in codes - {"data-misfit"} if code not in (*WIDENING, *HARMLESS)]:
        count, them = ("A warning says", "it") if len(grave) == 1 else (f"{len(grave)} warnings say", "them")
        yield f"{count} why the true stiffness may lie outside its range. Read {them} below."
    minima = {start["minimum"] for start in document["starts"] if start["minimum"] is not None}
    if len(minima) > 1:
        yield (
            f"The search found {len(minima)} different answers. The ranges include all that explain the images about as"
            " well."
        )


def _avoid(document: Mapping[str, Any], unit: ModulusUnit) -> Iterator[str]:
    """What not to do with the numbers."""
    of = _by_verdict(document)
    if lost := of.get("not identified"):
        yield f"Do not use any number for {listed(lost)}."
    if weak := of.get("weak"):
        yield f"Do not quote the number of {listed(weak)} without its range."
    case = document["case"]
    tissues = case.get("tissues", {})
    if ratios := of.get("ratio only"):
        given = tissues.get(unit.relative_to, {}).get("youngs_modulus_kpa")
        why = "no tissue of this body has a known stiffness in kPa"
        if isinstance(given, Sequence):
            why = f"the stiffness of {unit.relative_to} is known only between {given[0]:g} and {given[1]:g} kPa"
        yield f"Do not quote kilopascals for {listed(ratios)}: {why}."
    known = [
        f"{table['youngs_modulus_kpa']:g} kPa for {name}"
        for name, table in tissues.items()
        if table.get("role") == "known" and isinstance(table.get("youngs_modulus_kpa"), float | int)
    ]
    loads = ["the stated loads"] if case.get("loads") else []
    loads += ["the measured forces"] if any(data["kind"] == "force" for data in case.get("data", ())) else []
    usable = of.keys() & {"identified", "weak", "ratio only"}
    if usable and unit.name == "kPa" and (known or loads):
        wrong = (
            "one of these is wrong, the numbers are wrong" if known and loads else "the truth is twice that, all double"
        )
        yield f"Do not quote these numbers without what they assume: {listed([*known, *loads])}. If {wrong}."
    if usable:
        yield "Do not compare these numbers with those of elastography, which measures stiffness in another way."
        yield f"Do not compare them with numbers of another material law (here: {document['law']})."
    yield RESEARCH
