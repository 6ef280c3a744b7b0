"""Charts of a report: residuals and forces, convergence, angles of the mesh, and what is known of the moduli."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline, PchipInterpolator

from palpate.report.report_data import ModelSurface, ReportData
from palpate.report.rows import interval_text, moduli_in, number
from palpate.report.svg import INK, draw_svg, mark_decades
from palpate.report.units import ModulusUnit, shown_region, shown_unit
from palpate.uncertainty import NORMAL_95

SIZE = (3.9, 2.5)
DASHED = (0, (4, 3))
BINS = 41
BROAD: dict[str, Any] = {"color": "#c98b00", "linewidth": 7.0, "alpha": 0.6, "solid_capstyle": "butt"}
FITTED = "#3d8be0"
LIMIT = NORMAL_95**2  # deviance at the ends of a 95 % interval
ROW_INCHES, MOST_LETTERS = 0.3, 24
SHORT = 16  # letters of a tissue on an axis beside another one
START_COLOURS = ("#3b7dd8", "#d9822b", "#3a9d5d", "#b0559b", "#8a6d3b", "#4aa3a3", "#c0504d", "#7f7fd0")


def residual_svg(data: ReportData, model: ModelSurface, *, voxel_mm: float, name: str) -> str:
    """Histogram of one surface's signed distance (mm) at rest and fitted, with a voxel's edge marked, as SVG.

    Raises `ValueError` when none of the surface is observed.
    """
    tissue, voxel = data.tissues[model.tissue], voxel_mm
    seen = np.isfinite(model.distance_fitted) & np.isfinite(model.distance_rest)
    rest, fitted, area = (array[seen] for array in (model.distance_rest, model.distance_fitted, model.area))
    if not len(rest) or not area.sum() > 0.0:
        raise ValueError("none of this surface is observed")
    reach = max(1.6 * voxel, float(np.percentile(np.abs(np.concatenate([rest, fitted])), 99.0)))
    bins = np.linspace(-reach, reach, BINS)
    share = 100.0 * area / area.sum()
    spread = [number(float(np.sqrt(np.average(values**2, weights=area))), digits=2) for values in (rest, fitted)]
    says = f"Signed distances of {tissue.name}: root mean square {spread[0]} mm without a fit, {spread[1]} mm fitted."

    def draw(figure: Figure) -> None:
        """The two histograms over each other, values beyond the axis in its outer bins."""
        axes = figure.add_axes((0.14, 0.2, 0.83, 0.74))
        clipped = [np.clip(values, -reach, reach) for values in (fitted, rest)]
        with_fit, without = (np.histogram(values, bins, weights=share)[0] for values in clipped)
        axes.stairs(with_fit, bins, fill=True, color=tissue.colour, alpha=0.85, label="fitted")
        axes.stairs(without, bins, color=INK, linewidth=1.1, label="no fit")
        for place in (-voxel, voxel):
            axes.axvline(place, color=INK, linewidth=0.9, linestyle=DASHED)
        axes.text(voxel, 1.0, " one voxel", transform=axes.get_xaxis_transform(), fontsize=7.5, va="top")
        axes.set_xlim(-reach, reach)
        axes.set_xlabel("signed distance (mm)")
        axes.set_ylabel("share of the surface (%)")
        axes.yaxis.set_major_locator(MaxNLocator(4))

    return draw_svg(draw, size=SIZE, name=name, says=says)


def forces_svg(data: ReportData, *, name: str) -> str:
    """Each measured force (N) with its 95 % interval as a bar, the fitted one as a dot, one below the other, as SVG."""
    forces = data.document["forces"]
    parts = [
        f"{force['name']} measured {force['measured_n']:.4g} N, fitted {force['fitted_n']:.4g} N" for force in forces
    ]
    several = len({force["after"] for force in forces}) > 1
    labels = [f"{force['name']}, {force['after']}" if several else force["name"] for force in forces]

    def draw(figure: Figure) -> None:
        """A row for each force, the first one on top."""
        axes = figure.add_axes((0.34, 0.42 / figure.get_figheight(), 0.62, 1.0 - 0.62 / figure.get_figheight()))
        for row, force in enumerate(forces):
            half = NORMAL_95 * force["sd_n"]
            axes.plot(force["measured_n"] + half * np.array([-1.0, 1.0]), [row, row], **BROAD)
            axes.plot([force["fitted_n"]], [row], "o", color=FITTED, markersize=5.5, markeredgecolor="white")
        axes.set_yticks(range(len(forces)), [label[:MOST_LETTERS] for label in labels])
        axes.set_ylim(len(forces) - 0.4, -0.6)
        axes.margins(x=0.12)
        axes.set_xlabel("force (N)")
        axes.xaxis.set_major_locator(MaxNLocator(5))

    size = (SIZE[0], ROW_INCHES * len(forces) + 0.75)
    return draw_svg(draw, size=size, name=name, says=f"Forces: {'; '.join(parts)}.")


def objective_svg(data: ReportData, *, name: str) -> str:
    """Misfit (mm^2) of every start, and of the outer loop from their middle, against the iteration, as SVG."""
    histories = [start["history_mm2"] for start in data.document["starts"]]
    histories.append(data.document["outer_loop"]["history_mm2"])
    paths = [list(np.array(history, dtype=np.float64)) for history in histories]  # NaN for nothing
    says = f"Misfit by iteration. {_told(paths, 'mm²')}"
    return draw_svg(lambda figure: _paths(figure, paths, "misfit (mm²)"), size=SIZE, name=name, says=says)


def modulus_svg(data: ReportData, estimate: int, *, name: str) -> str:
    """Modulus of one estimate (its number) against the iteration, as in `objective_svg`, with its interval, as SVG."""
    item, unit = data.document["estimates"][estimate], shown_unit(data.document)
    paths = [[unit.of_document(value) for value in path.get(item["tissue"], ())] for path in data.moduli_paths]
    (_, interval), truth = unit.numbers(item), unit.truth(item)
    says = f"Stiffness of {item['tissue']} by iteration. {_told(paths, unit.text)}"

    def draw(figure: Figure) -> None:
        """The paths, the 95 % interval as a band and the truth as a dashed line, where they are known."""
        _paths(figure, paths, unit.axis)
        low, high = interval or (None, None)
        if low is not None and high is not None:
            figure.axes[0].axhspan(low, high, color=INK, alpha=0.1, linewidth=0)
        if truth is not None:
            figure.axes[0].axhline(truth, color=INK, linewidth=1.0, linestyle=DASHED)
        if figure.axes[0].get_yscale() == "log":
            mark_decades(figure.axes[0].yaxis, most=6)

    return draw_svg(draw, size=SIZE, name=name, says=says)


def waterfall_svg(data: ReportData, *, name: str) -> str:
    """Final misfits (mm^2) of the starts from the best to the worst, as SVG; hollow where a start did not converge."""
    starts = data.document["starts"]
    ends = np.array([start["objective_mm2"] for start in starts], dtype=np.float64)
    order = np.argsort(ends, kind="stable")
    told = ", ".join(f"start {rank + 1} {number(float(ends[rank]), digits=4)}" for rank in order)

    def draw(figure: Figure) -> None:
        """The starts as dots on a line."""
        axes = figure.add_axes((0.23, 0.2, 0.74, 0.74))
        axes.plot(range(1, len(order) + 1), ends[order], color=INK, linewidth=0.8, alpha=0.5)
        for rank, start in enumerate(order, start=1):
            colour = START_COLOURS[start % len(START_COLOURS)]
            filled = colour if starts[start]["status"] == "converged" else "none"
            axes.plot([rank], [ends[start]], "o", color=colour, markerfacecolor=filled, markersize=7)
        axes.set_xlabel("start, from best to worst (number)")
        axes.set_ylabel("final misfit (mm²)")
        axes.set_xlim(0.5, len(order) + 0.5)
        axes.xaxis.set_major_locator(MaxNLocator(6, integer=True))
        finite = ends[np.isfinite(ends)]
        if len(finite):  # never less than a tenth of the values: starts that agree must look as if they did
            low, high = float(finite.min()), float(finite.max())
            room = max(0.12 * (high - low), 0.05 * abs(high), 1e-12)
            axes.set_ylim(low - room, high + room)
            axes.yaxis.set_major_locator(MaxNLocator(4))
        axes.grid(visible=True, axis="y")

    says = f"Final misfits from the best to the worst start, mm²: {told}."
    return draw_svg(draw, size=SIZE, name=name, says=says)


def angle_svg(angles: NDArray[np.float32], *, name: str) -> str:
    """Histogram of a mesh's dihedral angles (n, 6), degrees, as SVG."""
    flat = angles.ravel()

    def draw(figure: Figure) -> None:
        """The histogram and the angle that the gate asks for."""
        axes = figure.add_axes((0.15, 0.2, 0.82, 0.74))
        share = np.full(len(flat), 100.0 / len(flat))
        axes.hist(flat, bins=list(range(0, 181, 5)), weights=share, color=START_COLOURS[0], alpha=0.85)
        axes.axvline(5.0, color=INK, linewidth=1.0, linestyle=DASHED)
        axes.set_xlim(0, 180)
        axes.set_xticks(range(0, 181, 30))
        axes.set_xlabel("dihedral angle (degrees)")
        axes.set_ylabel("share of the angles (%)")
        axes.yaxis.set_major_locator(MaxNLocator(4))

    least, middle, most = np.percentile(flat, [0.0, 50.0, 100.0])
    says = f"Dihedral angles of the mesh: from {least:.0f} to {most:.0f} degrees, half of them below {middle:.0f}."
    return draw_svg(draw, size=SIZE, name=name, says=says)


def profile_svg(data: ReportData, estimate: int, *, name: str) -> str:
    """Deviance of one estimate (its number) at each value of its modulus, all else at its best, as SVG.

    Between the points that were computed its signed root is monotone in ln E; the interval is a band, and the dashed
    line the deviance 1.96^2 at the ends of a profile's.
    """
    item, unit = data.document["estimates"][estimate], shown_unit(data.document)
    colour = _colour(data, item)
    value, interval = unit.numbers(item)
    at, root = np.array(sorted(unit.profile(item)), dtype=np.float64).T
    fine = np.linspace(np.log(at[0]), np.log(at[-1]), 201)
    between = PchipInterpolator(np.log(at), root)(fine)

    def draw(figure: Figure) -> None:
        """The profile with its points, the interval and the estimate."""
        axes = figure.add_axes((0.14, 0.2, 0.83, 0.74))
        room = (at[-1] / at[0]) ** 0.12
        ends = (at[0] / room, at[-1] * room)
        low, high = interval or (None, None)
        axes.axvspan(low or ends[0], high or ends[1], color=INK, alpha=0.1, linewidth=0)
        axes.plot(np.exp(fine), between**2, color=colour, linewidth=1.6)
        axes.plot(at, root**2, "o", color=colour, markersize=3.2)
        axes.axhline(LIMIT, color=INK, linewidth=0.9, linestyle=DASHED)
        axes.plot([np.nan if value is None else value], [0.0], "o", color=colour, markeredgecolor=INK, clip_on=False)
        axes.set_xscale("log")
        axes.set_xlim(*ends)
        axes.set_ylim(0.0, 1.6 * LIMIT)
        mark_decades(axes.xaxis, most=6)
        axes.set_xlabel(unit.axis)
        axes.set_ylabel("deviance (no unit)")
        axes.yaxis.set_major_locator(MaxNLocator(4))

    told = f"lowest at {number(value)} {unit.text}, 95 % interval {interval_text(interval)}"
    return draw_svg(draw, size=SIZE, name=name, says=f"Profile likelihood of {item['tissue']}: {told}.")


def region_svg(data: ReportData, region: int, *, name: str) -> str:
    """The joint 95 % region of two moduli (its number), with the ellipse, the estimate and the truth, as SVG.

    Between the directions that were computed the boundary is a periodic cubic spline of ln E.
    """
    of, unit = data.document["regions"][region], shown_unit(data.document)
    first, second = (next(i for i in moduli_in(data.document) if i["tissue"] == tissue) for tissue in of["tissues"])
    boundary, ellipse = map(_closed, shown_region(data.document, of))
    colour, truths = _colour(data, first), (unit.truth(first), unit.truth(second))

    def draw(figure: Figure) -> None:
        """Both boundaries on logarithmic axes."""
        axes = figure.add_axes((0.21, 0.26, 0.76, 0.7))
        axes.fill(*boundary, facecolor=colour, alpha=0.25, linewidth=0)
        axes.plot(*boundary, color=colour, linewidth=1.4)
        axes.plot(*ellipse, color=INK, linewidth=1.0, linestyle=DASHED)
        axes.plot([_value(first, unit)], [_value(second, unit)], "o", color=colour, markeredgecolor=INK)
        if truths[0] is not None and truths[1] is not None:
            axes.plot([truths[0]], [truths[1]], "x", color=INK, markersize=7)
        axes.set_xscale("log")
        axes.set_yscale("log")
        axes.set_xlabel(_of_tissue(first, unit))
        axes.set_ylabel(_of_tissue(second, unit))
        for axis in (axes.xaxis, axes.yaxis):
            mark_decades(axis, most=6)

    spans = [
        f"{t} {number(line.min())} to {number(line.max())}" for t, line in zip(of["tissues"], boundary, strict=True)
    ]
    says = f"Joint 95 % region: {' and '.join(spans)}{', cut by the bounds of the search' if of['open'] else ''}."
    return draw_svg(draw, size=SIZE, name=name, says=says)


def repeats_svg(data: ReportData, estimate: int, *, name: str) -> str:
    """One modulus (the estimate's number) as each later image alone says it, with the joint value, as SVG."""
    item, pairs, unit = moduli_in(data.document)[estimate], data.document["image_pairs"], shown_unit(data.document)
    tissue, colour = item["tissue"], _colour(data, item)
    alone = list[tuple[float | None, tuple[float, float] | None, bool]]()
    for pair in pairs["alone"]:
        of_image, ends = pair["moduli"].get(tissue), pair["interval95"].get(tissue)
        if of_image is None or ends is None:  # nothing of an image that has no minimum alone
            alone.append((None, None, pair["outlier"]))
        else:
            alone.append((unit.of_document(of_image), unit.ends(item, of_image, ends), pair["outlier"]))
    low, high = unit.ends(item, pairs["mean"][tissue], pairs["mean_interval95"][tissue])
    value, truth = _value(item, unit), unit.truth(item)

    def draw(figure: Figure) -> None:
        """A dot with its interval for each image, hollow where it is an outlier."""
        axes = figure.add_axes((0.16, 0.2, 0.81, 0.74))
        axes.axhspan(low, high, color=INK, alpha=0.1, linewidth=0)
        axes.axhline(value, color=INK, linewidth=1.0)
        if truth is not None:
            axes.axhline(truth, color=INK, linewidth=1.0, linestyle=DASHED)
        for place, (of_image, ends, outlier) in enumerate(alone, start=1):
            if of_image is None or ends is None:
                continue
            axes.plot([place, place], ends, color=colour, linewidth=1.6)
            inside = "none" if outlier else colour
            axes.plot([place], [of_image], "o", color=colour, markerfacecolor=inside, markersize=7)
        axes.set_xlim(0.5, len(alone) + 0.5)
        axes.set_xlabel("later image (number)")
        axes.set_ylabel(unit.axis)
        axes.set_yscale("log")
        axes.xaxis.set_major_locator(MaxNLocator(8, integer=True))
        mark_decades(axes.yaxis, most=6)

    parts = [f"{k} {number(one)}{' (an outlier)' if out else ''}" for k, (one, _, out) in enumerate(alone, start=1)]
    says = f"{tissue} by each later image alone, {unit.text}: {', '.join(parts)}; all together {number(value)}."
    return draw_svg(draw, size=SIZE, name=name, says=says)


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


def _of_tissue(item: Mapping[str, Any], unit: ModulusUnit) -> str:
    """The label of an axis of one tissue's modulus, short enough to stand beside another's."""
    name, to = (f"{of[: SHORT - 1]}…" if len(of) > SHORT else of for of in (item["tissue"], unit.relative_to))
    return f"E of {name} (kPa)" if unit.name == "kPa" else f"E of {name} /\nE of {to} (ratio)"


def _told(paths: list[list[float]], unit: str) -> str:
    """What the lines of `_paths` show, in words: where each begins and ends, in `unit`."""
    names = [*(f"start {k + 1}" for k in range(len(paths) - 1)), "outer loop"]
    ends = [
        f"{name} from {number(path[0])} to {number(path[-1])}" for name, path in zip(names, paths, strict=True) if path
    ]
    return f"{'; '.join(ends)} {unit}".strip() + "."


def _paths(figure: Figure, paths: list[list[float]], label: str) -> None:
    """One line a start on a logarithmic axis, and a thicker one for the last path, the outer loop's."""
    axes = figure.add_axes((0.23, 0.2, 0.74, 0.74))
    for start, path in enumerate(paths[:-1]):
        colour = START_COLOURS[start % len(START_COLOURS)]
        axes.plot(range(len(path)), path, color=colour, linewidth=1.6, marker="o", markersize=3.2)
    for path in (path for path in paths[-1:] if path):
        axes.plot(range(len(path)), path, color=INK, linewidth=2.4, marker="o", markersize=4.0)
        axes.annotate(
            "outer loop",
            (len(path) - 1, path[-1]),
            xytext=(3.0, 3.0),
            textcoords="offset points",
            ha="right",
            va="bottom",
            fontsize=7.5,
        )
    axes.set_xlabel("iteration (number)")
    axes.set_ylabel(label)
    axes.xaxis.set_major_locator(MaxNLocator(6, integer=True))
    values = np.array([value for path in paths for value in path])
    if len(values) and (values > 0).all():
        axes.set_yscale("log")
        mark_decades(axes.yaxis, most=6)
    axes.grid(visible=True, axis="y")
