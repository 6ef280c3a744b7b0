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

from palpate.report.report_data import (
    LaterImage,
    MeasuredPoints,
    MeasuredState,
    ReportData,
    SliceBox,
    TriangleSurface,
    Volume,
)
from palpate.report.section import VIEWS, Plane, cut_image, joined
from palpate.report.svg import draw_svg

WIDTH_INCHES = 4.6
SEEN, FITTED = ("#f0e442", 0.045), ("#4da3ff", 0.018)  # colour and width (inches) of arrows on black
ROLE_LEVELS = {"rigid": 1.0, "estimate": 0.6, "driver": 0.4, "known": 0.2, "void": 0.0}  # bones are what is aligned
OUTLINE = (withStroke(linewidth=1.5, foreground="#000000", alpha=0.7),)  # letters stay readable on bright bone


def first_planes(box: SliceBox) -> tuple[Plane, ...]:
    """The axial, coronal and sagittal plane that the page opens with."""
    return tuple(Plane(view, float(box.position[view.normal]), box.low, box.high) for view in VIEWS)


def contour_names(data: ReportData) -> tuple[tuple[str, str], ...]:
    """(name, colour) of every tissue whose contour is drawn."""
    drawn = dict.fromkeys(surface.tissue for reference in data.references for surface in reference.surfaces)
    return tuple((data.tissues[i].name, data.tissues[i].colour) for i in drawn)


def slice_svg(data: ReportData, plane: Plane, later: LaterImage, *, name: str, model: bool = True) -> str:
    """One slice as SVG: the earlier image under the contours of both images and of the model fitted to `later`.

    model: whether there is one.
    """
    reference = data.references[later.reference]

    def draw(figure: Figure) -> None:
        """Grey values, contours and furniture, one over the other."""
        axes = _backed(figure, data, reference.background, plane)
        for surface in later.surfaces:
            _lines(axes, data, plane, surface, gid="layer-after", linewidth=4.0, alpha=0.5)
        for surface in reference.surfaces:
            _lines(axes, data, plane, surface, gid="layer-before", linewidth=1.0, linestyle=(0, (1, 1.6)))
        for outline in later.outlines:
            _lines(axes, data, plane, outline, gid="layer-model", colors=["white"], linewidth=1.0)
        _furnish(axes, plane)

    where = f"{plane.view.name.capitalize()} slice at {'xyz'[plane.view.normal]} = {plane.position:.0f} mm"
    outlines = f"{reference.name}, {later.name} and the fitted model" if model else f"{reference.name} and {later.name}"
    says = f"{where}: {reference.name} under the outlines of {outlines}."
    return draw_svg(draw, size=_size(plane), name=name, says=says)


def points_svg(data: ReportData, plane: Plane, state: MeasuredState, *, name: str) -> str:
    """One slice as SVG: the outlines at rest and fitted, and arrows of the measured and the fitted motion near it."""
    reference, near = data.references[state.reference], 0
    for of in state.points:
        near += int(np.count_nonzero(_near(of, plane)))

    def draw(figure: Figure) -> None:
        """Grey values, contours, arrows and furniture, one over the other."""
        axes = _backed(figure, data, reference.background, plane)
        for surface in reference.surfaces:
            _lines(axes, data, plane, surface, gid="layer-before", linewidth=1.0, linestyle=(0, (1, 1.6)))
        for outline in state.outlines:
            _lines(axes, data, plane, outline, gid="layer-model", colors=["white"], linewidth=1.0)
        for of in state.points:
            here = _near(of, plane)
            _arrows(axes, plane, of.rest[here], state.motion_factor * of.observed[here], SEEN, "layer-seen")
            _arrows(axes, plane, of.rest[here], state.motion_factor * of.fitted[here], FITTED, "layer-fitted")
        _furnish(axes, plane)

    where = f"{plane.view.name.capitalize()} slice at {'xyz'[plane.view.normal]} = {plane.position:.0f} mm"
    says = f"{where}: measured and fitted motion of {near} points near it, as arrows."
    return draw_svg(draw, size=_size(plane), name=name, says=says)


def alignment_svg(data: ReportData, plane: Plane, later: LaterImage, *, name: str) -> str:
    """One slice as SVG: the earlier image in cyan over the later one in red, so that what agrees is grey.

    Raises `ValueError` when there are not both.
    """
    if len(later.both) != 2:
        raise ValueError("there are no images to be compared")

    def draw(figure: Figure) -> None:
        """Both images in one picture, and its furniture."""
        axes = figure.add_axes((0, 0, 1, 1))
        first, second = (_brightness(data, volume, plane) for volume in later.both)
        across, up = plane.axes
        both = np.stack([second, first, first], axis=2)
        axes.imshow(both, extent=(across[0], across[-1], up[0], up[-1]), origin="lower", interpolation="none")
        _furnish(axes, plane)

    reference = data.references[later.reference].name
    says = f"{plane.view.name.capitalize()} slice: {reference} in cyan over {later.name} in red; what agrees is grey."
    return draw_svg(draw, size=_size(plane), name=name, says=says)


def _size(plane: Plane) -> tuple[float, float]:
    """Of a picture of the plane, inches."""
    across, up = (float(plane.high[axis] - plane.low[axis]) for axis in (plane.view.across, plane.view.up))
    return WIDTH_INCHES, WIDTH_INCHES * up / across


def _furnish(axes: Axes, plane: Plane) -> None:
    """Letters of the sides, a bar of millimetres, and where the plane lies."""
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


def _backed(figure: Figure, data: ReportData, volume: Volume | None, plane: Plane) -> Axes:
    """Axes that fill the figure, with a volume on the plane: its window of greys, its tissues' colours, or black."""
    axes = figure.add_axes((0, 0, 1, 1))
    across, up = plane.axes
    shades = np.zeros((2, 2, 3))
    if volume is not None and volume.kind == "grey":
        shades = np.repeat(_brightness(data, volume, plane)[..., None], 3, axis=2)
    elif volume is not None:
        colours = [(0.0, 0.0, 0.0), *(0.06 + 0.3 * np.array(to_rgb(tissue.colour)) for tissue in data.tissues)]
        steps = np.nan_to_num(cut_image(volume.values, volume.grid, plane, order=0))
        shades = np.array(colours)[np.rint(steps).astype(int)]
    axes.imshow(shades, extent=(across[0], across[-1], up[0], up[-1]), origin="lower", interpolation="none")
    return axes


def _near(of: MeasuredPoints, plane: Plane) -> NDArray[np.bool_]:
    """Which of the points that are drawn (n,) the slice shows."""
    return np.asarray(np.abs(of.rest[:, plane.view.normal] - plane.position) <= of.near_mm)


def _arrows(
    axes: Axes,
    plane: Plane,
    rest: NDArray[np.float32],
    way: NDArray[np.float32],
    style: tuple[str, float],
    gid: str,
) -> None:
    """Arrows from points (n, 3) mm along (n, 3) mm, as they lie in the plane."""
    if len(rest):
        places = [of[:, axis] for of in (rest, way) for axis in (plane.view.across, plane.view.up)]
        options = {"angles": "xy", "scale_units": "xy", "scale": 1.0, "units": "inches", "minlength": 0.5}
        axes.quiver(*places, color=style[0], width=style[1], zorder=3.0, **options).set_gid(gid)


def _brightness(data: ReportData, volume: Volume, plane: Plane) -> NDArray[np.float64]:
    """Brightness (n_up, n_across), 0 to 1: of a volume's greys in its window, or of its tissues by their role."""
    if volume.kind == "grey":
        return volume.shade(np.nan_to_num(cut_image(volume.values, volume.grid, plane)))
    levels = np.array([0.0, *(ROLE_LEVELS[tissue.role] for tissue in data.tissues)])
    steps = np.nan_to_num(cut_image(volume.values, volume.grid, plane, order=0))
    return np.asarray(levels[np.rint(steps).astype(int)])


def _lines(axes: Axes, data: ReportData, plane: Plane, surface: TriangleSurface, *, gid: str, **style: Any) -> None:
    lines = joined(surface.points.astype(np.float64), surface.triangles.astype(np.int64), plane)
    collection = LineCollection(
        lines, **{"colors": [data.tissues[surface.tissue].colour], "capstyle": "round", "joinstyle": "round"} | style
    )
    collection.set_gid(gid)
    axes.add_collection(collection, autolim=False)


def _write(axes: Axes, x: float, y: float, text: str, **style: Any) -> None:
    axes.text(x, y, text, transform=axes.transAxes, color="white", path_effects=OUTLINE, **style)
