"""Moduli with their 95 % intervals on a logarithmic axis, in kPa or as ratios."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from matplotlib.axes import Axes
from matplotlib.figure import Figure

from palpate.errors import ConfigurationError
from palpate.report.figures.sheet import COLUMN_MM, size_mm
from palpate.report.rows import interval_text, moduli_in, number
from palpate.report.svg import mark_decades
from palpate.report.units import ModulusUnit, UnitName, shown_unit

GREY = "#888888"
ROOM = 1.6  # by which factor the axis reaches beyond all numbers, for the arrows of open ends
ROW_MM, FRAME_MM = 11.0, 15.0


def chosen_unit(document: Mapping[str, Any], name: str | None) -> ModulusUnit:
    """The unit that is asked for, "kPa" or "ratio", or for None that in which the report states the moduli.

    Raises `ConfigurationError` for another name, and where the result has no numbers in that unit.
    """
    stated = shown_unit(document)
    if name is None:
        return stated
    names: dict[str, UnitName] = {"kPa": "kPa", "ratio": "ratio"}
    if name not in names:
        raise ConfigurationError(f"there is no unit '{str(name)[:40]}' of moduli; choose 'kPa' or 'ratio'")
    if name == "kPa" and stated.name == "ratio":
        raise ConfigurationError(
            f"the images give these moduli as ratios to '{stated.relative_to}' alone, so a figure in kPa would show"
            " numbers that are not known; ask for the unit 'ratio'"
        )
    unit = shown_unit(document, names[name])
    if name == "ratio" and not any(item["ratio"] for item in moduli_in(document)) and stated.name == "kPa":
        raise ConfigurationError(
            "this result has no ratios: known loads set the scale, and no tissue has a known modulus; ask for 'kPa'"
        )
    return unit


def draw_moduli(axes: Axes, document: Mapping[str, Any], colours: Mapping[str, str], unit: ModulusUnit) -> None:
    """Draw the moduli of result.json on axes: a bar an interval, a dot an estimate, an arrow an open end.

    colours: tissue -> #rrggbb. What did not converge is named without a number.
    """
    items = moduli_in(document)
    numbers = [unit.truth(item) for item in items]
    for item in items:
        value, interval = unit.numbers(item)
        numbers += [value, *(interval or ())]
    known = [found for found in numbers if found]
    axes.set_xscale("log")
    axes.set_xlim(min(known, default=1.0) / ROOM, max(known, default=1.0) * ROOM)
    mark_decades(axes.xaxis)
    for row, item in enumerate(items):
        _row(axes, row, item, colours.get(item["tissue"], GREY), unit)
    axes.set_yticks(range(len(items)), [f"{item['tissue']}\n{item['verdict']}" for item in items])
    axes.set_ylim(len(items) - 0.4, -0.7)
    axes.set_xlabel(f"{unit.axis}, 95 % interval")
    axes.grid(visible=True, axis="x", alpha=0.3, linewidth=0.5)
    axes.set_axisbelow(True)


def _row(axes: Axes, row: int, item: Mapping[str, Any], colour: str, unit: ModulusUnit) -> None:
    """One modulus: its interval, its value in numbers above it, the truth of a simulation as a dash."""
    (value, interval), truth, ends = unit.numbers(item), unit.truth(item), axes.get_xlim()
    if truth is not None:
        axes.plot([truth] * 2, [row - 0.1, row + 0.32], color="black", linestyle=(0, (2, 1.2)), gid="truth")
    if value is None:
        where = axes.get_yaxis_transform()
        axes.text(0.5, row, "no value", transform=where, ha="center", va="center", color="#595959")
        return
    low, high = interval or (value, value)  # a dot alone where no interval is stated
    line = [low or ends[0], high or ends[1]]
    axes.plot(line, [row, row], color=colour, linewidth=5, alpha=0.55, solid_capstyle="butt", gid="interval")
    for end, marker, place in ((low, "<", ends[0]), (high, ">", ends[1])):
        if end is None:
            axes.plot(place, row, marker=marker, color=colour, markersize=9, clip_on=False, gid="open")
    axes.plot(value, row, "o", color=colour, markeredgecolor="black", markeredgewidth=0.7, markersize=5)
    words = f"{number(value)} ({interval_text(interval)})" if interval else number(value)
    axes.annotate(words, (value, row), (0, 6), textcoords="offset points", ha="center", va="bottom", fontsize="smaller")


def moduli_sheet(figure: Figure, document: Mapping[str, Any], colours: Mapping[str, str], unit: ModulusUnit) -> str:
    """The figure in one column, in that unit, and its caption."""
    items = moduli_in(document)
    size_mm(figure, COLUMN_MM, FRAME_MM + ROW_MM * max(len(items), 1))
    figure.set_layout_engine("constrained")
    draw_moduli(figure.add_subplot(), document, colours, unit)
    what = (
        "Young's modulus in kPa" if unit.name == "kPa" else f"Young's modulus as a ratio to that of {unit.relative_to}"
    )
    truth = any(unit.truth(item) is not None for item in items)
    return (
        f"{what}, for each tissue that was estimated. Dots are the estimates, bars their 95 % intervals; the axis is"
        " logarithmic. An arrow marks an end that the images leave open."
        + (" The dashed line is the true value of the simulation." if truth else "")
        + " The word under each name is the verdict of the program."
    )
