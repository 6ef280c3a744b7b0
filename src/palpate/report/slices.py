"""Three orthogonal slices with the organs' contours before, after and in the fitted model, for paper."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from matplotlib.patheffects import withStroke
from numpy.typing import NDArray

from palpate.report.report_data import LaterImage, ReportData, SliceBox, TriangleSurface
from palpate.report.section import VIEWS, Plane, cut_image, joined
from palpate.report.svg import draw_svg

__all__ = ["contour_names", "first_planes", "slice_svg"]

WIDTH_INCHES = 4.6
OUTLINE = (withStroke(linewidth=1.5, foreground="#000000", alpha=0.7),)  # letters stay readable on bright bone


def first_planes(box: SliceBox) -> tuple[Plane, ...]:
    """The axial, coronal and sagittal plane that the page opens with."""
    return tuple(Plane(view, float(box.position[view.normal]), box.low, box.high) for view in VIEWS)


def contour_names(data: ReportData) -> tuple[tuple[str, str], ...]:
    """(name, colour) of every tissue whose contour is drawn."""
    drawn = dict.fromkeys(surface.tissue for reference in data.references for surface in reference.surfaces)
    return tuple((data.tissues[i].name, data.tissues[i].colour) for i in drawn)


def slice_svg(data: ReportData, plane: Plane, later: LaterImage, *, name: str) -> str:
    """One slice as SVG: the earlier image under the contours of both images and of the model fitted to `later`."""
    across, up = (float(plane.high[axis] - plane.low[axis]) for axis in (plane.view.across, plane.view.up))

    def draw(figure: Figure) -> None:
        """Grey values, contours and furniture, one over the other."""
        axes = figure.add_axes((0, 0, 1, 1))
        _background(axes, data, plane, number=later.reference)
        for surface in later.surfaces:
            _lines(axes, data, plane, surface, gid="layer-after", linewidth=4.0, alpha=0.5)
        for surface in data.references[later.reference].surfaces:
            _lines(axes, data, plane, surface, gid="layer-before", linewidth=1.0, linestyle=(0, (1, 1.6)))
        for model in later.model:
            lines = joined(model.fitted.astype(np.float64), model.triangles.astype(np.int64), plane)
            _add(axes, lines, gid="layer-model", colors=["white"], linewidth=1.0)
        view = plane.view
        axes.set_xlim(plane.high[view.across], plane.low[view.across])
        axes.set_ylim(plane.low[view.up], plane.high[view.up])
        axes.set_axis_off()
        places = ((0.025, 0.5), (0.975, 0.5), (0.5, 0.97), (0.5, 0.03))
        for letter, (x, y) in zip(view.letters, places, strict=True):
            _write(axes, x, y, letter, ha="center", va="center", fontweight="bold")
        where = f"{'xyz'[view.normal]} = {plane.position:.0f} mm"
        _write(axes, 0.975, 0.03, where, ha="right", va="center", fontsize=7)
        width = float(plane.high[view.across] - plane.low[view.across])
        bar = next(size for size in (50.0, 20.0, 10.0, 5.0, 1.0, 0.0) if size < 0.4 * width)
        left, bottom = plane.high[view.across] - 0.06 * width, plane.low[view.up] + 0.06 * width
        stroke = [withStroke(linewidth=3.4, foreground="#000000")]
        ends = [left, left - bar]
        axes.plot(ends, [bottom] * 2, color="white", linewidth=2.0, solid_capstyle="butt", path_effects=stroke)
        place = (left, bottom + 0.015 * width)
        axes.text(*place, f"{bar:g} mm", color="white", ha="left", va="bottom", fontsize=8, path_effects=OUTLINE)

    return draw_svg(draw, size=(WIDTH_INCHES, WIDTH_INCHES * up / across), name=name)


def _background(axes: Axes, data: ReportData, plane: Plane, *, number: int) -> None:
    """The earlier image of reference state `number`."""
    across, up = plane.axes
    extent = (across[0], across[-1], up[0], up[-1])
    volume = data.references[number].background
    if volume is None:
        axes.imshow(np.zeros((2, 2)), cmap="gray", extent=extent, origin="lower")
        return
    cut = np.nan_to_num(cut_image(volume.values, volume.grid, plane, order=1 if volume.kind == "grey" else 0))
    if volume.kind == "grey":
        axes.imshow(cut, cmap="gray", vmin=0, vmax=255, extent=extent, origin="lower", interpolation="none")
        return
    colours = np.array([(0.0, 0.0, 0.0), *(0.06 + 0.3 * np.array(to_rgb(tissue.colour)) for tissue in data.tissues)])
    axes.imshow(colours[np.rint(cut).astype(int)], extent=extent, origin="lower", interpolation="none")


def _lines(axes: Axes, data: ReportData, plane: Plane, surface: TriangleSurface, *, gid: str, **style: Any) -> None:
    lines = joined(surface.points.astype(np.float64), surface.triangles.astype(np.int64), plane)
    _add(axes, lines, gid=gid, colors=[data.tissues[surface.tissue].colour], **style)


def _add(axes: Axes, lines: list[NDArray[np.float64]], *, gid: str, **style: Any) -> None:
    collection = LineCollection(lines, capstyle="round", **style)
    collection.set_gid(gid)
    axes.add_collection(collection, autolim=False)


def _write(axes: Axes, x: float, y: float, text: str, **style: Any) -> None:
    axes.text(x, y, text, transform=axes.transAxes, color="white", path_effects=OUTLINE, **style)
