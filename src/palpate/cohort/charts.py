"""Charts of a cohort: boxes by stage, patients against the stage, patients with their intervals."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from palpate.report.svg import INK, link_url, mark_decades

SIZE = (4.4, 3.0)
ROW = 0.2  # inches of a patient in the forest
MOST_IN_FOREST = 150
COLOUR = "#0072b2"
LINE = "#d55e00"
OPEN = "#777777"  # what is known of a scan without a value
SPREAD = 0.18  # of points beside each other at a stage

Patients = Sequence[Mapping[str, Any]]
Links = Mapping[str, int]
"""Number of the link to each patient's report."""


def boxes(figure: Figure, patients: Patients, tissue: str, unit: str, links: Links) -> str:
    """Quartiles of all scans of each stage, and the medians of its patients as points, with both numbers.

    Where scans of a stage have no value there is no box, which would leave them out: their ends stand among the others'
    values, as arrows to where they may lie. Raises `ValueError` when nobody has a stage.
    """
    stages, axes = _stages(patients, tissue), _axes(figure, *SIZE)
    axes.set_yscale("log")
    labels = []
    for stage in stages:
        own = [patient for patient in patients if patient["stage"] == stage and tissue in patient["summary"]]
        scans = [value for patient in own for value in patient["kpa"].get(tissue) or patient["ratio"].get(tissue) or []]
        censored = [ends for patient in own for ends in patient["summary"][tissue]["censored"]]
        if censored:
            axes.plot([stage] * len(scans), scans, "_", color=INK)
            for ends in censored:
                _draw_ends(axes, stage, ends)
        else:
            axes.boxplot(
                scans,
                positions=[stage],
                widths=0.55,
                showfliers=False,
                boxprops={"color": INK},
                medianprops={"color": LINE},
                whiskerprops={"color": INK},
                capprops={"color": INK},
            )
        medians = [(p, found) for p in own if (found := p["summary"][tissue]["median"]) is not None]
        for place, (patient, median) in zip(stage + _beside(len(medians)), medians, strict=True):
            points = axes.plot(place, median, "o", color=COLOUR, markersize=4.5, alpha=0.85)
            _link(points[0], patient, links)
        n = len(scans) + len(censored)
        who = f"{len(own)} patient{'s' * (len(own) != 1)}"
        labels.append(f"{stage}\n{who}\n{n} scan{'s' * (n != 1)}")
    axes.set_xticks(stages, labels)
    axes.set_xlim(min(stages) - 0.6, max(stages) + 0.6)
    _label(axes, unit)
    return f"{tissue}: quartiles of the scans' {_axis(unit)} at each stage, medians of patients as points"


def scatter(figure: Figure, patients: Patients, tissue: str, unit: str, line: Mapping[str, Any], links: Links) -> str:
    """Each patient's combined modulus with its 95 % interval against the stage, and the regression's line.

    Arrows are ends of scans without a value. line: `regression` of statistics.json. Raises `ValueError` when nobody has
    a stage.
    """
    stages, axes = _stages(patients, tissue), _axes(figure, *SIZE)
    axes.set_yscale("log")
    for stage in stages:
        own = [p for p in patients if p["stage"] == stage and tissue in p["summary"]]
        for place, patient in zip(stage + _beside(len(own)), own, strict=True):
            summary = patient["summary"][tissue]
            if (found := summary["combined"]) is not None:
                axes.plot([place, place], [found["low95"], found["high95"]], color=COLOUR, linewidth=1.4, alpha=0.6)
                _link(axes.plot(place, found["value"], "o", color=COLOUR, markersize=4.5)[0], patient, links)
            for ends in summary["censored"]:
                _draw_ends(axes, place, ends)
    factor = line.get("factor_per_stage")
    if factor is not None:
        ends = np.array([min(stages), max(stages)], dtype=float)
        axes.plot(ends, line["at_mean_stage"] * factor ** (ends - line["mean_stage"]), color=LINE, linewidth=1.4)
    axes.set_xticks(stages)
    axes.set_xlim(min(stages) - 0.6, max(stages) + 0.6)
    _label(axes, unit)
    return f"{tissue}: each patient's {_axis(unit)} with its 95 % interval against the stage, and a line through them"


def forest(figure: Figure, patients: Patients, tissue: str, unit: str, links: Links) -> str:
    """Each patient's combined modulus with its 95 % interval, a line each, by stage.

    Arrows are ends of scans without a value. Raises `ValueError` when there are none, or too many to be drawn.
    """
    own = [patient for patient in patients if tissue in patient["summary"]]
    if not 0 < len(own) <= MOST_IN_FOREST:
        raise ValueError(f"{len(own)} patients have a modulus; 1 to {MOST_IN_FOREST} are drawn")
    own.sort(key=lambda patient: (patient["stage"] is None, patient["stage"] or 0))
    axes = _axes(figure, SIZE[0], 0.7 + ROW * len(own))
    axes.set_xscale("log")
    for number, patient in enumerate(own):
        if (found := patient["summary"][tissue]["combined"]) is not None:
            axes.plot([found["low95"], found["high95"]], [number, number], color=COLOUR, linewidth=2.5, alpha=0.6)
            _link(axes.plot(found["value"], number, "s", color=COLOUR, markersize=4.0)[0], patient, links)
        for ends in patient["summary"][tissue]["censored"]:
            _draw_ends(axes, number, ends, along=True)
    stages = ["" if p["stage"] is None else f", stage {p['stage']}" for p in own]
    axes.set_yticks(
        range(len(own)), [f"{p['patient'][:24]}{stage}" for p, stage in zip(own, stages, strict=True)], fontsize=7.5
    )
    axes.set_ylim(len(own) - 0.5, -0.5)
    mark_decades(axes.xaxis)
    axes.set_xlabel(_axis(unit))
    return f"{tissue}: each patient's {_axis(unit)} with its 95 % interval, by stage"


def _axes(figure: Figure, width: float, height: float) -> Axes:
    figure.set_size_inches(width, height)
    return figure.subplots()


def _link(artist: Artist, patient: Mapping[str, Any], links: Links) -> None:
    """Make the point of a patient a link to the page, where there is one."""
    if patient["patient"] in links:
        artist.set_url(link_url(links[patient["patient"]]))


def _draw_ends(axes: Axes, place: float, ends: Sequence[float | None], *, along: bool = False) -> None:
    """Arrows at the ends that are known of a scan, to where its modulus may lie; `along` the horizontal axis."""
    for end, marker in zip(ends, "><" if along else "^v", strict=True):
        if end is not None:
            x, y = (end, place) if along else (place, end)
            axes.plot(x, y, marker, color=OPEN, markersize=5.0, fillstyle="none")


def _stages(patients: Patients, tissue: str) -> list[int]:
    found = sorted({p["stage"] for p in patients if p["stage"] is not None and tissue in p["summary"]})
    if not found:
        raise ValueError("no patient has a stage and a modulus that counts")
    return found


def _beside(count: int) -> Any:
    return np.linspace(-SPREAD, SPREAD, count) if count > 1 else np.zeros(count)


def _axis(unit: str) -> str:
    return "Young's modulus (kPa)" if unit == "kPa" else "E / E of reference tissue (ratio)"


def _label(axes: Axes, unit: str) -> None:
    axes.set_xlabel("stage (number)")
    axes.set_ylabel(_axis(unit))
    mark_decades(axes.yaxis)
