"""Charts of a report: residuals and forces, convergence, angles of the mesh, and what is known of the moduli.

Each is drawn on an empty figure, and gives what it shows in words.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline, PchipInterpolator

from palpate.report.report_data import ModelSurface, ReportData
from palpate.report.rows import interval_text, moduli_in, number
from palpate.report.svg import INK, mark_decades
from palpate.report.units import ModulusUnit, shown_region, shown_unit
from palpate.uncertainty import NORMAL_95

DASHED = (0, (4, 3))
BINS = 41
BROAD: dict[str, Any] = {"color": "#c98b00", "linewidth": 7.0, "alpha": 0.6, "solid_capstyle": "butt"}
FITTED = "#3d8be0"
LIMIT = NORMAL_95**2  # deviance at the ends of a 95 % interval
ROW_INCHES, MOST_LETTERS = 0.3, 24
SHORT = 16  # letters of a tissue on an axis beside another one
START_COLOURS = ("#3b7dd8", "#d9822b", "#3a9d5d", "#b0559b", "#8a6d3b", "#4aa3a3", "#c0504d", "#7f7fd0")


def residuals(figure: Figure, data: ReportData, model: ModelSurface, voxel_mm: float) -> str:
    """Histogram of one surface's signed distance (mm) at rest and fitted, with a voxel's edge marked.

    Values beyond the axis are in its outer bins. Raises `ValueError` when none of the surface is observed.
    """
    tissue, spread = data.tissues[model.tissue], spread_words(model)
    if not spread:
        raise ValueError("none of this surface is observed")
    seen = model.observed
    rest, fitted, area = (array[seen] for array in (model.distance_rest, model.distance_fitted, model.area))
    reach = max(1.6 * voxel_mm, float(np.percentile(np.abs(np.concatenate([rest, fitted])), 99.0)))
    bins, share = np.linspace(-reach, reach, BINS), 100.0 * area / area.sum()
    with_fit, without = (np.histogram(np.clip(of, -reach, reach), bins, weights=share)[0] for of in (fitted, rest))
    axes = figure.subplots()
    axes.stairs(with_fit, bins, fill=True, color=tissue.colour, alpha=0.85)
    axes.stairs(without, bins, color=INK, linewidth=1.1)
    for place in (-voxel_mm, voxel_mm):
        axes.axvline(place, color=INK, linewidth=0.9, linestyle=DASHED)
    axes.text(voxel_mm, 1.0, " one voxel", transform=axes.get_xaxis_transform(), fontsize=7.5, va="top")
    axes.set(xlim=(-reach, reach), xlabel="signed distance (mm)", ylabel="share of the surface (%)")
    axes.yaxis.set_major_locator(MaxNLocator(4))
    return f"Signed distances of {tissue.name}: root mean square {spread}."


def spread_words(model: ModelSurface) -> str:
    """Root mean square distances of one surface, by area, in words; nothing where it is not observed."""
    seen = model.observed
    area = model.area[seen].astype(np.float64)
    if not area.sum() > 0.0:
        return ""
    squares = (of[seen].astype(np.float64) ** 2 for of in (model.distance_rest, model.distance_fitted))
    rest, fitted = (number(float(np.sqrt(np.average(of, weights=area))), digits=2) for of in squares)
    return f"{rest} mm without a fit, {fitted} mm fitted"


def forces(figure: Figure, document: Mapping[str, Any]) -> str:
    """Each measured force (N) with its 95 % interval as a bar, the fitted one as a dot, one below the other."""
    found = document["forces"]
    figure.set_figheight(ROW_INCHES * len(found) + 0.75)
    axes, several = figure.subplots(), len({force["after"] for force in found}) > 1
    for row, force in enumerate(found):
        half = NORMAL_95 * force["sd_n"]
        axes.plot(force["measured_n"] + half * np.array([-1.0, 1.0]), [row, row], **BROAD)
        axes.plot([force["fitted_n"]], [row], "o", color=FITTED, markersize=5.5, markeredgecolor="white")
    labels = [f"{force['name']}, {force['after']}" if several else force["name"] for force in found]
    axes.set_yticks(range(len(found)), [label[:MOST_LETTERS] for label in labels])
    axes.set(ylim=(len(found) - 0.4, -0.6), xlabel="force (N)")
    axes.margins(x=0.12)
    axes.xaxis.set_major_locator(MaxNLocator(5))
    parts = [f"{of['name']} measured {of['measured_n']:.4g} N, fitted {of['fitted_n']:.4g} N" for of in found]
    return f"Forces: {'; '.join(parts)}."


def objective(figure: Figure, document: Mapping[str, Any]) -> str:
    """Misfit (mm^2) of every start, and of the outer loop from their middle, against the iteration."""
    histories = [start["history_mm2"] for start in document["starts"]] + [document["outer_loop"]["history_mm2"]]
    paths = [list(np.array(history, dtype=np.float64)) for history in histories]  # NaN for nothing
    _draw_paths(figure.subplots(), paths, "misfit (mm²)")
    return f"Misfit by iteration. {_ends_of(paths, 'mm²')}"


def modulus(figure: Figure, data: ReportData, item: Mapping[str, Any]) -> str:
    """The modulus of an estimate against the iteration, as in `objective`, its interval a band, the truth dashed."""
    unit, axes = shown_unit(data.document), figure.subplots()
    paths = [[unit.of_document(value) for value in path.get(item["tissue"], ())] for path in data.moduli_paths]
    _draw_paths(axes, paths, unit.axis)
    low, high = unit.numbers(item)[1] or (None, None)
    if low is not None and high is not None:
        axes.axhspan(low, high, color=INK, alpha=0.1, linewidth=0)
    _draw_truth(axes, unit.truth(item))
    if axes.get_yscale() == "log":
        mark_decades(axes.yaxis, most=6)
    return f"Stiffness of {item['tissue']} by iteration. {_ends_of(paths, unit.text)}"


def waterfall(figure: Figure, document: Mapping[str, Any]) -> str:
    """Final misfits (mm^2) of the starts from the best to the worst; hollow where a start did not converge."""
    starts, axes = document["starts"], figure.subplots()
    ends = np.array([start["objective_mm2"] for start in starts], dtype=np.float64)
    order = np.argsort(ends, kind="stable")
    axes.plot(range(1, len(order) + 1), ends[order], color=INK, linewidth=0.8, alpha=0.5)
    for rank, start in enumerate(order, start=1):
        colour = START_COLOURS[start % len(START_COLOURS)]
        filled = colour if starts[start]["status"] == "converged" else "none"
        axes.plot([rank], [ends[start]], "o", color=colour, markerfacecolor=filled, markersize=7)
    axes.set(xlabel="start, from best to worst (number)", ylabel="final misfit (mm²)", xlim=(0.5, len(order) + 0.5))
    axes.xaxis.set_major_locator(MaxNLocator(6, integer=True))
    finite = ends[np.isfinite(ends)]
    if len(finite):  # never less than a tenth of the values: starts that agree must look as if they did
        low, high = float(finite.min()), float(finite.max())
        room = max(0.12 * (high - low), 0.05 * abs(high), 1e-12)
        axes.set_ylim(low - room, high + room)
        axes.yaxis.set_major_locator(MaxNLocator(4))
    axes.grid(visible=True, axis="y")
    told = ", ".join(f"start {rank + 1} {number(float(ends[rank]), digits=4)}" for rank in order)
    return f"Final misfits from the best to the worst start, mm²: {told}."


def angles(figure: Figure, dihedral: NDArray[np.float32]) -> str:
    """Histogram of a mesh's dihedral angles (n, 6), degrees, with the angle that the gate asks for."""
    flat, axes = dihedral.ravel(), figure.subplots()
    share = np.full(len(flat), 100.0 / len(flat))
    axes.hist(flat, bins=list(range(0, 181, 5)), weights=share, color=START_COLOURS[0], alpha=0.85)
    axes.axvline(5.0, color=INK, linewidth=1.0, linestyle=DASHED)
    axes.set(xlim=(0, 180), xlabel="dihedral angle (degrees)", ylabel="share of the angles (%)")
    axes.set_xticks(range(0, 181, 30))
    axes.yaxis.set_major_locator(MaxNLocator(4))
    least, middle, most = np.percentile(flat, [0.0, 50.0, 100.0])
    return f"Dihedral angles of the mesh: from {least:.0f} to {most:.0f} degrees, half of them below {middle:.0f}."


def profile(figure: Figure, data: ReportData, item: Mapping[str, Any]) -> str:
    """Deviance of an estimate at each value of its modulus, all else at its best.

    Between the points that were computed its signed root is monotone in ln E; the interval is a band, and the dashed
    line the deviance 1.96^2 at the ends of a profile's.
    """
    unit, colour, axes = shown_unit(data.document), _colour(data, item), figure.subplots()
    value, interval = unit.numbers(item)
    at, root = np.array(sorted(unit.profile(item)), dtype=np.float64).T
    fine = np.linspace(np.log(at[0]), np.log(at[-1]), 201)
    room = (at[-1] / at[0]) ** 0.12
    ends = (at[0] / room, at[-1] * room)
    low, high = interval or (None, None)
    axes.axvspan(low or ends[0], high or ends[1], color=INK, alpha=0.1, linewidth=0)
    axes.plot(np.exp(fine), PchipInterpolator(np.log(at), root)(fine) ** 2, color=colour, linewidth=1.6)
    axes.plot(at, root**2, "o", color=colour, markersize=3.2)
    axes.axhline(LIMIT, color=INK, linewidth=0.9, linestyle=DASHED)
    axes.plot([np.nan if value is None else value], [0.0], "o", color=colour, markeredgecolor=INK, clip_on=False)
    axes.set(xscale="log", xlim=ends, ylim=(0.0, 1.6 * LIMIT), xlabel=unit.axis, ylabel="deviance (no unit)")
    mark_decades(axes.xaxis, most=6)
    axes.yaxis.set_major_locator(MaxNLocator(4))
    told = f"lowest at {number(value)} {unit.text}, 95 % interval {interval_text(interval)}"
    return f"Profile likelihood of {item['tissue']}: {told}."


def region(figure: Figure, data: ReportData, of: Mapping[str, Any]) -> str:
    """A joint 95 % region of two moduli, with the ellipse, the estimate and the truth, on logarithmic axes.

    Between the directions that were computed the boundary is a periodic cubic spline of ln E.
    """
    unit, axes = shown_unit(data.document), figure.subplots()
    first, second = (next(i for i in moduli_in(data.document) if i["tissue"] == tissue) for tissue in of["tissues"])
    boundary, ellipse = map(_closed, shown_region(data.document, of))
    colour, truths = _colour(data, first), (unit.truth(first), unit.truth(second))
    axes.fill(*boundary, facecolor=colour, alpha=0.25, linewidth=0)
    axes.plot(*boundary, color=colour, linewidth=1.4)
    axes.plot(*ellipse, color=INK, linewidth=1.0, linestyle=DASHED)
    axes.plot([_value(first, unit)], [_value(second, unit)], "o", color=colour, markeredgecolor=INK)
    if truths[0] is not None and truths[1] is not None:
        axes.plot([truths[0]], [truths[1]], "x", color=INK, markersize=7)
    axes.set(xscale="log", yscale="log", xlabel=_of_tissue(first, unit), ylabel=_of_tissue(second, unit))
    for axis in (axes.xaxis, axes.yaxis):
        mark_decades(axis, most=6)
    ends = [
        f"{t} {number(line.min())} to {number(line.max())}" for t, line in zip(of["tissues"], boundary, strict=True)
    ]
    return f"Joint 95 % region: {' and '.join(ends)}{', cut by the bounds of the search' if of['open'] else ''}."


def repeats(figure: Figure, data: ReportData, item: Mapping[str, Any]) -> str:
    """One modulus as each later image alone says it, hollow where it is an outlier, with the joint value."""
    pairs, unit, axes = data.document["image_pairs"], shown_unit(data.document), figure.subplots()
    tissue, colour, value = item["tissue"], _colour(data, item), _value(item, unit)
    low, high = unit.ends(item, pairs["mean"][tissue], pairs["mean_interval95"][tissue])
    axes.axhspan(low, high, color=INK, alpha=0.1, linewidth=0)
    axes.axhline(value, color=INK, linewidth=1.0)
    _draw_truth(axes, unit.truth(item))
    told = []
    for place, pair in enumerate(pairs["alone"], start=1):
        alone, ends = pair["moduli"].get(tissue), pair["interval95"].get(tissue)
        shown = None
        if alone is not None and ends is not None:  # nothing of an image that has no minimum alone
            shown = unit.of_document(alone)
            axes.plot([place, place], unit.ends(item, alone, ends), color=colour, linewidth=1.6)
            inside = "none" if pair["outlier"] else colour
            axes.plot([place], [shown], "o", color=colour, markerfacecolor=inside, markersize=7)
        told.append(f"{place} {number(shown)}{' (an outlier)' if pair['outlier'] else ''}")
    axes.set(xlim=(0.5, len(told) + 0.5), xlabel="later image (number)", yscale="log", ylabel=unit.axis)
    axes.xaxis.set_major_locator(MaxNLocator(8, integer=True))
    mark_decades(axes.yaxis, most=6)
    return f"{tissue} by each later image alone, {unit.text}: {', '.join(told)}; all together {number(value)}."


def _closed(corners: Sequence[tuple[float, float]]) -> NDArray[np.float64]:
    """A smooth closed line (2, n) through places (n_corners, 2), both kPa or ratios."""
    logarithms = np.log(np.array([*corners, corners[0]]))
    line = CubicSpline(np.arange(len(logarithms)), logarithms, bc_type="periodic")
    return np.asarray(np.exp(line(np.linspace(0.0, len(corners), 241))).T)


def _colour(data: ReportData, item: Mapping[str, Any]) -> str:
    return next((tissue.colour for tissue in data.tissues if tissue.name == item["tissue"]), "#888888")


def _value(item: Mapping[str, Any], unit: ModulusUnit) -> float:
    value = unit.numbers(item)[0]
    return np.nan if value is None else value


def _draw_truth(axes: Axes, truth: float | None) -> None:
    if truth is not None:
        axes.axhline(truth, color=INK, linewidth=1.0, linestyle=DASHED)


def _of_tissue(item: Mapping[str, Any], unit: ModulusUnit) -> str:
    """The label of an axis of one tissue's modulus, short enough to stand beside another's."""
    name, to = (f"{of[: SHORT - 1]}…" if len(of) > SHORT else of for of in (item["tissue"], unit.relative_to))
    return f"E of {name} (kPa)" if unit.name == "kPa" else f"E of {name} /\nE of {to} (ratio)"


def _ends_of(paths: list[list[float]], unit: str) -> str:
    """What the lines of `_draw_paths` show, in words: where each begins and ends, in `unit`."""
    names = [*(f"start {k + 1}" for k in range(len(paths) - 1)), "outer loop"]
    ends = [
        f"{name} from {number(path[0])} to {number(path[-1])}" for name, path in zip(names, paths, strict=True) if path
    ]
    return f"{'; '.join(ends)} {unit}".strip() + "."


def _draw_paths(axes: Axes, paths: list[list[float]], label: str) -> None:
    """One line a start on a logarithmic axis, and a thicker one for the last path, the outer loop's."""
    for start, path in enumerate(paths[:-1]):
        colour = START_COLOURS[start % len(START_COLOURS)]
        axes.plot(range(len(path)), path, color=colour, linewidth=1.6, marker="o", markersize=3.2)
    for path in (path for path in paths[-1:] if path):
        axes.plot(range(len(path)), path, color=INK, linewidth=2.4, marker="o", markersize=4.0)
        style: dict[str, Any] = {"textcoords": "offset points", "ha": "right", "va": "bottom", "fontsize": 7.5}
        axes.annotate("outer loop", (len(path) - 1, path[-1]), (3.0, 3.0), **style)
    axes.set(xlabel="iteration (number)", ylabel=label)
    axes.xaxis.set_major_locator(MaxNLocator(6, integer=True))
    values = np.array([value for path in paths for value in path])
    if len(values) and (values > 0).all():
        axes.set_yscale("log")
        mark_decades(axes.yaxis, most=6)
    axes.grid(visible=True, axis="y")
