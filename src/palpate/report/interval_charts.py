"""Charts of what is known of the moduli: profiles, joint regions of two, and what each later image says alone."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from matplotlib.axis import Axis
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, MaxNLocator, NullFormatter
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline, PchipInterpolator

from palpate.report.report_data import ReportData
from palpate.report.rows import interval_text, main_numbers, moduli_in, number
from palpate.report.svg import INK, draw_svg
from palpate.uncertainty import NORMAL_95

SIZE = (3.9, 2.5)
DASHED = (0, (4, 3))
LIMIT = NORMAL_95**2  # deviance at the ends of a 95 % interval


def profile_svg(data: ReportData, estimate: int, *, name: str) -> str:
    """Deviance of one estimate (its number) at each value of its modulus, all else at its best, as SVG.

    Between the points that were computed its signed root is monotone in ln E; the interval is a band, and the dashed
    line the deviance 1.96^2 at the ends of a profile's.
    """
    item = data.document["estimates"][estimate]
    colour = _colour(data, item)
    value, interval = main_numbers(item)
    at, root = np.array(sorted(item["profile"]), dtype=np.float64).T
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
        _plain_numbers(axes.xaxis)
        axes.set_xlabel(_label(item))
        axes.set_ylabel("deviance")
        axes.yaxis.set_major_locator(MaxNLocator(4))

    told = f"lowest at {number(value)}, 95 % interval {interval_text(interval)}"
    return draw_svg(draw, size=SIZE, name=name, says=f"Profile likelihood of {item['tissue']}: {told}.")


def region_svg(data: ReportData, region: int, *, name: str) -> str:
    """The joint 95 % region of two moduli (its number), with the ellipse, the estimate and the truth, as SVG.

    Between the directions that were computed the boundary is a periodic cubic spline of ln E.
    """
    of = data.document["regions"][region]
    first, second = (next(i for i in moduli_in(data.document) if i["tissue"] == tissue) for tissue in of["tissues"])
    boundary, ellipse = _closed(of["boundary"]), _closed(of["ellipse"])
    colour = _colour(data, first)

    def draw(figure: Figure) -> None:
        """Both boundaries on logarithmic axes."""
        axes = figure.add_axes((0.16, 0.2, 0.81, 0.74))
        axes.fill(*boundary, facecolor=colour, alpha=0.25, linewidth=0)
        axes.plot(*boundary, color=colour, linewidth=1.4)
        axes.plot(*ellipse, color=INK, linewidth=1.0, linestyle=DASHED)
        axes.plot([_value(first)], [_value(second)], "o", color=colour, markeredgecolor=INK)
        if first["truth"] is not None and second["truth"] is not None:
            axes.plot([first["truth"]], [second["truth"]], "x", color=INK, markersize=7)
        axes.set_xscale("log")
        axes.set_yscale("log")
        axes.set_xlabel(_label(first, of_tissue=True))
        axes.set_ylabel(_label(second, of_tissue=True))
        for axis in (axes.xaxis, axes.yaxis):
            _plain_numbers(axis)

    spans = [
        f"{t} {number(line.min())} to {number(line.max())}" for t, line in zip(of["tissues"], boundary, strict=True)
    ]
    says = f"Joint 95 % region: {' and '.join(spans)}{', cut by the bounds of the search' if of['open'] else ''}."
    return draw_svg(draw, size=SIZE, name=name, says=says)


def repeats_svg(data: ReportData, estimate: int, *, name: str) -> str:
    """One modulus (the estimate's number) as each later image alone says it, with the joint value, as SVG."""
    item, pairs = moduli_in(data.document)[estimate], data.document["image_pairs"]
    tissue, colour = item["tissue"], _colour(data, item)
    alone = [  # nothing of an image that has no minimum alone
        (pair["moduli"].get(tissue), pair["interval95"].get(tissue), pair["outlier"]) for pair in pairs["alone"]
    ]
    low, high = pairs["mean_interval95"][tissue]

    def draw(figure: Figure) -> None:
        """A dot with its interval for each image, hollow where it is an outlier."""
        axes = figure.add_axes((0.16, 0.2, 0.81, 0.74))
        axes.axhspan(low, high, color=INK, alpha=0.1, linewidth=0)
        axes.axhline(_value(item), color=INK, linewidth=1.0)
        if item["truth"] is not None:
            axes.axhline(item["truth"], color=INK, linewidth=1.0, linestyle=DASHED)
        for place, (value, ends, outlier) in enumerate(alone, start=1):
            if value is None:
                continue
            axes.plot([place, place], ends, color=colour, linewidth=1.6)
            inside = "none" if outlier else colour
            axes.plot([place], [value], "o", color=colour, markerfacecolor=inside, markersize=7)
        axes.set_xlim(0.5, len(alone) + 0.5)
        axes.set_xlabel("later image")
        axes.set_ylabel(_label(item))
        axes.set_yscale("log")
        axes.xaxis.set_major_locator(MaxNLocator(8, integer=True))
        _plain_numbers(axes.yaxis)

    told = [f"{k} {number(value)}{' (an outlier)' if out else ''}" for k, (value, _, out) in enumerate(alone, start=1)]
    says = f"{tissue} by each later image alone: {', '.join(told)}; all together {number(_value(item))}."
    return draw_svg(draw, size=SIZE, name=name, says=says)


def _closed(corners: list[list[float]]) -> NDArray[np.float64]:
    """A smooth closed line (2, n) through places (n_corners, 2), both kPa or ratios."""
    logarithms = np.log(np.array([*corners, corners[0]]))
    line = CubicSpline(np.arange(len(logarithms)), logarithms, bc_type="periodic")
    return np.asarray(np.exp(line(np.linspace(0.0, len(corners), 241))).T)


def _colour(data: ReportData, item: Mapping[str, Any]) -> str:
    return next((tissue.colour for tissue in data.tissues if tissue.name == item["tissue"]), "#888888")


def _value(item: Mapping[str, Any]) -> float:
    value = main_numbers(item)[0]
    return np.nan if value is None else value


def _label(item: Mapping[str, Any], *, of_tissue: bool = False) -> str:
    """The quantity of an axis, with its unit."""
    quantity = "E (kPa)" if item["unit"] == "kPa" else f"E / {item['relative_to'][:24]}"
    return f"{item['tissue'][:24]}, {quantity}" if of_tissue else quantity


def _plain_numbers(axis: Axis) -> None:
    """A few round numbers on a logarithmic axis that spans less than a decade."""
    axis.set_major_locator(MaxNLocator(5))
    axis.set_major_formatter(FuncFormatter(lambda tick, _: f"{tick:.3g}"))
    axis.set_minor_formatter(NullFormatter())
