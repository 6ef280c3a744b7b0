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
NO_SCALE = "The images show only how stiff the tissues are beside each other, so that each number is a ratio."


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
                "The reason stands in the coloured box above.",
            ),
            ("Do not use any number or picture of this page as a result.", RESEARCH),
        )
    unit = shown_unit(document)
    return Summary(
        (
            "The program compared states of one body and sought the stiffness that explains how they differ.",
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
    if item["verdict"] == "weak":
        return f"roughly {about}. {_between(interval, 'Any value')} would fit the images nearly as well."
    kpa = ""
    if unit.name == "ratio" and item["verdict"] == "identified" and item["value"] is not None:
        kpa = f" That is about {number(item['value'], digits=2)} kPa."
    return f"about {about}. {_between(interval, 'The true value probably lies')}{'.' if interval else ''}{kpa}"


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
    known = [*of.get("identified", ()), *of.get("ratio only", ())]
    if good := of.get("identified"):
        yield f"The images fix the stiffness of {listed(good)} well: within a factor of two to each side."
    if ratios := of.get("ratio only"):
        yield f"The images fix the stiffness of {listed(ratios)} only in comparison with {unit.relative_to}."
    if weak := of.get("weak"):
        yield f"The stiffness of {listed(weak)} is uncertain: the range counts, not the single number."
    if lost := of.get("not identified"):
        yield f"Nothing is known about the stiffness of {listed(lost)}."
    if known:
        yield (
            "'Probably' means: of 100 such ranges about 95 hold the true value, if what the model assumes is right"
            " (95 % interval)."
        )
    codes = {str(warning["code"]) for warning in document["warnings"]}
    if "data-misfit" in codes:
        yield "The model does not explain all of the data: the errors can be larger than the ranges say."
    if grave := [code for code in codes - {"data-misfit"} if code not in (*WIDENING, *HARMLESS)]:
        count, them = ("A warning says", "it") if len(grave) == 1 else (f"{len(grave)} warnings say", "them")
        yield f"{count} what can make a number wrong by more than its range; read {them} below."
    minima = {start["minimum"] for start in document["starts"] if start["minimum"] is not None}
    if len(minima) > 1:
        yield f"The search found {len(minima)} different answers; the one that fits best is shown."


def _avoid(document: Mapping[str, Any], unit: ModulusUnit) -> Iterator[str]:
    """What not to do with the numbers."""
    of = _by_verdict(document)
    if lost := of.get("not identified"):
        yield f"Do not use any number for {listed(lost)}."
    if weak := of.get("weak"):
        yield f"Do not quote the number of {listed(weak)} without its range."
    tissues = document["case"].get("tissues", {})
    if ratios := of.get("ratio only"):
        given = tissues.get(unit.relative_to, {}).get("youngs_modulus_kpa")
        why = "no stiffness in kPa is known in this body"
        if isinstance(given, Sequence):
            why = f"the stiffness of {unit.relative_to} is known only between {given[0]:g} and {given[1]:g} kPa"
        yield f"Do not quote kilopascals for {listed(ratios)}: {why}."
    known = [
        (name, table["youngs_modulus_kpa"])
        for name, table in tissues.items()
        if table.get("role") == "known" and isinstance(table.get("youngs_modulus_kpa"), float | int)
    ]
    if known and unit.name == "kPa":
        what = listed([f"{kpa:g} kPa for {name}" for name, kpa in known])
        yield f"Do not forget what was assumed: {what}. If that is wrong by a factor, all numbers are wrong by it."
    if unit.name == "kPa" or of.keys() & {"identified", "weak", "ratio only"}:
        yield (
            f"Do not compare these numbers with those of another material law (here: {document['law']}) or of another"
            " method, such as elastography, as if they were the same quantity."
        )
    yield RESEARCH
