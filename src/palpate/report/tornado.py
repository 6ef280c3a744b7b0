"""What each assumption does to a modulus, largest effect first: as rows, as a tornado chart, as sensitivity.html."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial
from typing import Any

from markupsafe import Markup
from matplotlib.figure import Figure

from palpate.report.rows import interval_text, number
from palpate.report.svg import INK, draw_svg, page_of
from palpate.report.units import ModulusUnit, shown_unit
from palpate.statement.variations import NAMES, ratio_change

COLOURS = ("#3b7dd8", "#d9822b")  # of what lowers the modulus, and of what raises it
WIDEST = math.log(4.0)  # of ln E on the axis: what reaches further ends in an arrow
LEAST = math.log(1.05)
MARKS = (0.25, 0.5, 0.67, 0.8, 0.9, 0.95, 1.0, 1.05, 1.1, 1.25, 1.5, 2.0, 4.0)
LETTERS = 34  # of a label


@dataclass(frozen=True, slots=True)
class TornadoRow:
    """One assumption and what its settings do to one modulus: ln E' / E by setting, in their order.

    method: how they were found; covered: whether the 95 % interval holds what is not known of it; at_bound: settings
    at which the modulus runs to the bounds of the search; failed: setting -> why there is no estimate.
    """

    label: str
    method: str
    covered: bool
    effects: Mapping[str, float]
    at_bound: tuple[str, ...]
    failed: Mapping[str, str]

    @property
    def size(self) -> float:
        """The largest effect, of |ln E' / E|; -1 where there is none."""
        return max(map(abs, self.effects.values()), default=-1.0)

    @property
    def ends(self) -> tuple[float, float]:
        """Least and largest ln E' / E, the unchanged estimate among them."""
        return min(0.0, *self.effects.values(), 0.0), max(0.0, *self.effects.values(), 0.0)


def tornado_rows(document: Mapping[str, Any], tissue: str) -> tuple[TornadoRow, ...]:
    """Those of one tissue of a document sensitivity.json or result.json, the largest effect first.

    Where the document's moduli are shown as ratios, so are the effects: ln of a ratio over the estimated one.
    """
    unit = shown_unit(document)
    groups: dict[tuple[str, str], list[Mapping[str, Any]]] = {}
    for variation in document["variations"]:
        groups.setdefault((variation["cause"], variation["subject"]), []).append(variation)
    rows = []
    for (cause, subject), members in groups.items():
        found = [m for m in members if m["changes"] is not None]
        rows.append(
            TornadoRow(
                NAMES.get(cause, cause).format(subject),
                members[0]["method"],
                is_covered(document, cause, subject),
                {m["setting"]: _effect(m, tissue, unit) for m in found},
                tuple(m["setting"] for m in found if tissue in m["at_bound"]),
                {m["setting"]: m["reason"] for m in members if m["changes"] is None},
            )
        )
    return tuple(sorted(rows, key=lambda row: -row.size))


def is_covered(document: Mapping[str, Any], cause: str, subject: str) -> bool:
    """Whether the 95 % interval of a document's moduli holds what is not known of an assumption.

    It does of unknowns of the estimate with a prior of their own: Poisson's ratios, how surfaces are drawn, a frame
    that moves, a known modulus that is a range; and of the mesh, by a term of the variance. It does not of the material
    law, of a known modulus that is a number, of another boundary or alignment, nor of the priors themselves.
    """
    case = document["case"]
    left_out, tissue = case.get("discrepancy", {}), case.get("tissues", {}).get(subject, {})
    held: dict[str, bool] = {
        "poisson_ratio": left_out.get("poisson_sd", 0.0) > 0.0,
        "segmentation": left_out.get("surface_offset_mm", 0.0) > 0.0,
        "frame": case.get("domain", {}).get("outer_boundary") == "moving",
        "known_modulus": isinstance(tissue.get("youngs_modulus_kpa"), list | tuple),
        "edge_length": True,
    }
    return held.get(cause, False)


def coverage(document: Mapping[str, Any]) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Assumptions that were varied: those that the 95 % interval holds, and those that it does not hold."""
    bars = dict.fromkeys((each["cause"], each["subject"]) for each in document.get("variations", ()))
    named = [(NAMES.get(cause, cause).format(subject), is_covered(document, cause, subject)) for cause, subject in bars]
    return tuple(name for name, held in named if held), tuple(name for name, held in named if not held)


def _effect(variation: Mapping[str, Any], tissue: str, unit: ModulusUnit) -> float:
    """What a variation does to ln of a tissue's modulus in that unit."""
    change = float(variation["changes"][tissue])
    if unit.name == "kPa":
        return change
    of = variation["cause"], variation["subject"], variation["setting"]
    return round(ratio_change(change, *of, relative_to=unit.relative_to), 12) + 0.0


def effect_text(row: TornadoRow, *, reasons: bool = False) -> str:
    """What each setting does, in per cent of what is shown: "0.43: -3 %, 0.47: +4 %".

    Of one without a change "no estimate", or, with `reasons`, why there is none.
    """
    words = []
    for setting, change in row.effects.items():
        end = " (at the search's bound)" if setting in row.at_bound else ""
        words.append(f"{setting}: {f'{100.0 * math.expm1(change):+.3g} %' if change else 'no change'}{end}")
    words += [f"{setting}: {why if reasons else 'no estimate'}" for setting, why in row.failed.items()]
    return ", ".join(words)


def sensitivity_table(document: Mapping[str, Any]) -> list[list[str]]:
    """Rows of cells, a heading first: modulus of each tissue, then what changes it, the largest effect first."""
    unit = shown_unit(document)
    quantity = "modulus" if unit.name == "kPa" else "ratio"
    rows = [["tissue", "changed", quantity, "method", "in the interval"]]
    for item in document["estimates"]:
        value, interval = unit.numbers(item)
        rows.append([item["tissue"], "-", f"{number(value)} {unit.text} (95 %: {interval_text(interval)})", "", ""])
        found = tornado_rows(document, item["tissue"])
        rows += [
            ["", row.label, effect_text(row, reasons=True), row.method, "yes" if row.covered else "no"] for row in found
        ]
    return rows


def tornado(figure: Figure, document: Mapping[str, Any], tissue: str) -> str:
    """The tornado of one tissue's modulus on a logarithmic axis of E' / E, its 95 % interval as a band.

    A bar a row, blue to the left and orange to the right, a tick a setting. Raises `ValueError` where nothing was
    varied.
    """
    rows = [row for row in tornado_rows(document, tissue) if row.effects]
    if not rows:
        raise ValueError("nothing was varied")
    figure.set_size_inches(7.2, 0.8 + 0.3 * len(rows))
    axes, unit, reach = figure.subplots(), shown_unit(document), min(1.15 * max(rows[0].size, LEAST), WIDEST)
    value, interval = unit.numbers(next(item for item in document["estimates"] if item["tissue"] == tissue))
    if value and interval:
        low, high = (math.log(e / value) if e else sign * reach for e, sign in zip(interval, (-1, 1), strict=True))
        axes.axvspan(max(low, -reach), min(high, reach), color=INK, alpha=0.1, linewidth=0)
    for place, row in enumerate(rows):
        for end, colour in zip(row.ends, COLOURS, strict=True):
            axes.barh(place, max(-reach, min(end, reach)), height=0.62, color=colour, alpha=0.85)
            if abs(end) > reach:
                marker = ">" if end > 0.0 else "<"
                axes.plot(math.copysign(reach, end), place, marker=marker, color=INK, markersize=6, clip_on=False)
        inside = [change for change in row.effects.values() if abs(change) <= reach]
        axes.plot(inside, [place] * len(inside), "|", color=INK, markersize=7)
    axes.axvline(0.0, color=INK, linewidth=0.9)
    labels = [row.label if len(row.label) <= LETTERS else f"{row.label[: LETTERS - 3]}..." for row in rows]
    axes.set_yticks(range(len(rows)), labels)
    marks = [1.0]  # round ratios within the axis, not closer than a twelfth of it
    for mark in sorted(MARKS, key=lambda m: -abs(math.log(m))):
        apart = min(abs(math.log(mark / other)) for other in marks)
        if abs(math.log(mark)) <= reach and apart >= reach / 6.0:
            marks.append(mark)
    axes.set_xticks([math.log(mark) for mark in marks], [f"{mark:.3g}" for mark in marks])
    changed = "modulus" if unit.name == "kPa" else f"ratio to {unit.relative_to[:LETTERS]}"
    axes.set(xlim=(-reach, reach), ylim=(len(rows) - 0.4, -0.6), xlabel=f"{changed} / its estimate (no unit)")
    axes.grid(visible=True, axis="x")
    return f"Tornado of {tissue}: {'; '.join(f'{row.label}: {effect_text(row)}' for row in rows)}."


def sensitivity_page(document: Mapping[str, Any]) -> str:
    """The page of a document sensitivity.json; all names in it are escaped."""
    tissues, unit = [], shown_unit(document)
    for item in document["estimates"]:
        value, interval = unit.numbers(item)
        chart = draw_svg(partial(tornado, document=document, tissue=item["tissue"]))
        tissues.append(
            {
                "name": item["tissue"],
                "value": number(value),
                "unit": unit.text,
                "interval": interval_text(interval),
                "chart": Markup(chart),  # noqa: S704 - ours
                "rows": [(row, effect_text(row)) for row in tornado_rows(document, item["tissue"])],
            }
        )
    return page_of("sensitivity.html", document=document, tissues=tissues, unit=unit)
