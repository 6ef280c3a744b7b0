"""The estimates of a result alone: as lines, as cards for a notebook, as a figure with their intervals."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import matplotlib as mpl
from matplotlib.figure import Figure

from palpate.report.rows import NONE, estimate_rows, interval_text, main_numbers, moduli_in, ratio_rows
from palpate.report.svg import mark_decades, template_of

GREY = "#888888"
ROOM = 1.6  # by which factor the axis reaches beyond all numbers, for the arrows of open ends
STYLE = {"text.parse_math": False, "font.family": "DejaVu Sans"}  # a tissue called $x is a name, not a formula


def result_lines(document: Mapping[str, Any]) -> str:
    """A line a tissue of the document result.json: value with its 95 % interval, verdict and why."""
    lines = [] if document["status"] == "converged" else [f"{document['status']}: {document['reason']}"]
    for row in estimate_rows(document, {}):
        found = "no value"
        if row.value != NONE and row.verdict == "ratio only":  # whose scale is known within a range
            found = f"{row.ratio} x {row.relative_to} (95 %: {row.ratio_interval}), {row.value} kPa if it has"
            found += f" {row.reference} kPa"
        elif row.value != NONE:
            found = f"{row.value} kPa" + (f" (95 %: {row.interval} kPa)" if row.interval != NONE else "")
        elif row.ratio != NONE:
            found = f"{row.ratio} x {row.relative_to}"
            found += f" (95 %: {row.ratio_interval})" if row.ratio_interval != NONE else ""
        lines.append(f"{row.tissue}: {found}, {row.verdict}: {row.why}")
    return "\n".join(lines)


def result_cards(document: Mapping[str, Any], colours: Mapping[str, str]) -> str:
    """HTML with a card a tissue: value, interval, verdict and why, escaped; then the warnings.

    document: result.json; colours: tissue -> #rrggbb.
    """
    rows, ratios = estimate_rows(document, colours), ratio_rows(document)
    return str(template_of("cards.html").render(document=document, rows=rows, ratios=ratios))


def moduli_figure(document: Mapping[str, Any], colours: Mapping[str, str]) -> Figure:
    """A figure of the moduli (kPa, or ratios) with their 95 % intervals; open ends are arrows, truths dashes.

    document, colours: as above. What did not converge is named without a number.
    """
    items = moduli_in(document)
    with mpl.rc_context(STYLE):
        figure = Figure(figsize=(6.4, 1.2 + 0.55 * max(len(items), 1)), layout="constrained")
        axes = figure.add_subplot()
        axes.set_xscale("log")
        numbers = [item["truth"] for item in items]
        for item in items:
            value, interval = main_numbers(item)
            numbers += [value, *(interval or ())]
        known = [number for number in numbers if number]
        axes.set_xlim(min(known, default=1.0) / ROOM, max(known, default=1.0) * ROOM)
        mark_decades(axes.xaxis)
        ends = axes.get_xlim()
        for row, item in enumerate(items):
            value, interval = main_numbers(item)
            colour = colours.get(item["tissue"], GREY)
            if item["truth"] is not None:
                axes.plot([item["truth"]] * 2, [row - 0.3, row + 0.3], color="black", linestyle="--", label="truth")
            if value is None:
                where = axes.get_yaxis_transform()
                axes.text(0.5, row, "no value", transform=where, ha="center", va="center", color=GREY)
                continue
            low, high = interval or (value, value)  # a dot alone where no interval is stated
            line = [low or ends[0], high or ends[1]]
            axes.plot(line, [row, row], color=colour, linewidth=5, alpha=0.55, gid="interval")
            for end, marker, place in ((low, "<", ends[0]), (high, ">", ends[1])):
                if end is None:
                    axes.plot(place, row, marker=marker, color=colour, markersize=9, clip_on=False, gid="open")
            words = f"{value:.3g} ({interval_text(interval)})"
            axes.plot(value, row, "o", color=colour, markeredgecolor="black", label=words)
        axes.set_yticks(range(len(items)), [f"{item['tissue']}\n{item['verdict']}" for item in items])
        axes.set_ylim(len(items) - 0.5, -0.5)
        in_kpa = all(item["unit"] == "kPa" for item in items)
        axes.set_xlabel("Young's modulus (kPa), 95 % interval" if in_kpa else "ratio of moduli, 95 % interval")
        axes.grid(visible=True, axis="x", alpha=0.3)
    return figure
