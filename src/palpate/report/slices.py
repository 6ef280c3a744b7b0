"""Three orthogonal slices for paper: contours before, after and in the fitted model; Young's modulus; displacement."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from matplotlib.patheffects import withStroke
from numpy.typing import NDArray

from palpate.report.cut_mesh import cut_mesh, element_moduli, motion_of
from palpate.report.measured import nice_factor
from palpate.report.report_data import (
    LaterImage,
    MeasuredState,
    ReportData,
    SliceBox,
    TriangleSurface,
    Volume,
)
from palpate.report.scales import Scale, displacement_scale, modulus_scale
from palpate.report.section import VIEWS, Plane, cut_image, joined

WIDTH_INCHES = 4.6
DOTTED = (0, (1, 1.6))
FADED = 0.15  # part of the scale of displacements in which the colours fade, so that what stands still stays grey
LEAST_ARROW_MM = 1.5  # as it is drawn
OPACITY = 0.6  # of what is coloured, over the image
ARROW_STEP_MM, ARROW_REACH = 9.0, 13.0  # between arrows of the motion; of ten steps, how long most of them are at most
SEEN, FITTED = ("#f0e442", 0.045), ("#4da3ff", 0.018)  # colour and width (inches) of arrows on black
ROLE_LEVELS = {"rigid": 1.0, "estimate": 0.6, "driver": 0.4, "known": 0.2, "void": 0.0}  # bones are what is aligned
OUTLINE = (withStroke(linewidth=1.5, foreground="#000000", alpha=0.7),)  # letters stay readable on bright bone


def first_planes(box: SliceBox) -> tuple[Plane, ...]:
    """The axial, coronal and sagittal plane that the page opens with."""
    return tuple(Plane(view, float(box.position[view.normal]), box.low, box.high) for view in VIEWS)


def contour_names(data: ReportData) -> tuple[tuple[str, str], ...]:
    """(name, colour) of every tissue whose contour is drawn."""
    drawn = sorted({surface.tissue for reference in data.references for surface in reference.surfaces})
    return tuple((data.tissues[i].name, data.tissues[i].colour) for i in drawn)


def slice_chart(figure: Figure, data: ReportData, plane: Plane, later: LaterImage, *, model: bool = True) -> str:
    """The earlier image under the contours of both images and of the model fitted to `later`, if there is one."""
    reference = data.references[later.reference]
    paint_contours(_fill(figure, plane), data, plane, later, reference.background)
    outlines = f"{reference.name}, {later.name} and the fitted model" if model else f"{reference.name} and {later.name}"
    return f"{_where(plane)}: {reference.name} under the outlines of {outlines}."


def stiffness_chart(figure: Figure, data: ReportData, plane: Plane, later: LaterImage) -> str:
    """The earlier image, that of the mesh, under the Young's moduli that were found; raises as `paint_stiffness`."""
    paint_stiffness(_fill(figure, plane), data, plane)
    return f"{_where(plane)}: {modulus_scale(data).label} over {data.references[later.reference].name}."


def displacement_chart(figure: Figure, data: ReportData, plane: Plane, later: LaterImage) -> str:
    """The earlier image under the fitted motion; raises as `paint_displacement`."""
    paint_displacement(_fill(figure, plane), data, plane, later)
    names = f"from {data.references[later.reference].name} to {later.name}"
    return f"{_where(plane)}: fitted motion {names}, up to {displacement_scale(later).high:.3g} mm."


def paint_contours(
    axes: Axes, data: ReportData, plane: Plane, later: LaterImage, volume: Volume | None, *, small: bool = False
) -> None:
    """A volume under contours: broad of the later image, dotted of the earlier one, white of the fitted model.

    small: thinner ones, in a figure for paper, as below.
    """
    thin = 0.75 if small else 1.0
    show_shades(axes, plane, shades_of(data, volume, plane))
    for surface in later.surfaces:
        draw_lines(axes, data, plane, surface, gid="layer-after", linewidth=4.0 * thin, alpha=0.5)
    draw_outlines(axes, data, plane, data.references[later.reference].surfaces, later.outlines, thin=thin)
    furnish(axes, plane, small=small)


def draw_outlines(
    axes: Axes,
    data: ReportData,
    plane: Plane,
    rest: Sequence[TriangleSurface],
    fitted: Sequence[TriangleSurface],
    *,
    thin: float = 1.0,
) -> None:
    """Contours of what is at rest, dotted, and as the fitted model carries it, white."""
    for surface in rest:
        draw_lines(axes, data, plane, surface, gid="layer-before", linewidth=thin, linestyle=DOTTED)
    for outline in fitted:
        draw_lines(axes, data, plane, outline, gid="layer-model", colors=["white"], linewidth=thin)


def paint_stiffness(axes: Axes, data: ReportData, plane: Plane, *, small: bool = False) -> None:
    """The first reference state under the Young's moduli that were found, and the organs' contours there.

    Raises `ValueError` where there is no mesh, or no modulus.
    """
    _paint_field(axes, data, plane, stiffness_on(data, plane), modulus_scale(data), small=small)
    furnish(axes, plane, small=small)


def paint_displacement(axes: Axes, data: ReportData, plane: Plane, later: LaterImage, *, small: bool = False) -> None:
    """The first reference state under the length of the fitted motion, and arrows of its part in the plane.

    Raises `ValueError` where there is no mesh, or no motion.
    """
    motion = motion_on(data, plane, later)
    lengths = np.linalg.norm(motion, axis=2)
    _paint_field(axes, data, plane, lengths, displacement_scale(later), full=FADED, small=small)
    motion_arrows(axes, plane, motion, arrow_factor(later), small=small)
    furnish(axes, plane, small=small)


def _paint_field(
    axes: Axes,
    data: ReportData,
    plane: Plane,
    values: NDArray[np.float64],
    scale: Scale,
    *,
    full: float = 0.0,
    small: bool,
) -> None:
    reference = data.references[0]
    show_shades(axes, plane, coloured(shades_of(data, reference.background, plane), values, scale, full=full))
    for surface in reference.surfaces:
        draw_lines(axes, data, plane, surface, gid="layer-before", linewidth=0.8 if small else 1.1)


def stiffness_on(data: ReportData, plane: Plane) -> NDArray[np.float64]:
    """Young's modulus (n_up, n_across) of what was estimated, in the unit that is shown, on a plane; NaN elsewhere.

    The plane is one of the first reference state. Raises `ValueError` where there is no mesh or no modulus.
    """
    return cut_mesh(data, plane).of_elements(element_moduli(data))


def motion_on(data: ReportData, plane: Plane, later: LaterImage) -> NDArray[np.float64]:
    """The fitted motion (n_up, n_across, 3) mm on a plane, NaN outside the mesh; raises as `motion_of` does."""
    return cut_mesh(data, plane).of_nodes(motion_of(later))


def arrow_factor(later: LaterImage) -> float:
    """How many times longer than the fitted motion its arrows are drawn, so that neighbours do not hide each other."""
    lengths = np.linalg.norm(motion_of(later), axis=1)
    return nice_factor(lengths[lengths > 0.0] if (lengths > 0.0).any() else lengths, ARROW_REACH * ARROW_STEP_MM)


def longer(factor: float) -> str:
    """How long arrows are drawn, in words."""
    return "as long as the motion" if factor == 1.0 else f"{factor:g} times as long as the motion"


def motion_arrows(axes: Axes, plane: Plane, motion: NDArray[np.float64], factor: float, *, small: bool = False) -> None:
    """Arrows of a motion (n_up, n_across, 3) mm on a plane, one every `ARROW_STEP_MM`, `factor` times as long.

    small: thinner ones, in a figure for paper.
    """
    across, up = plane.axes
    step = max(round(ARROW_STEP_MM / float(across[1] - across[0])), 1)
    rows, columns = np.meshgrid(*(np.arange(step // 2, n, step) for n in motion.shape[:2]), indexing="ij")
    way = motion[rows, columns]
    inside = factor * np.linalg.norm(np.nan_to_num(way), axis=2) > LEAST_ARROW_MM
    feet = np.zeros((int(inside.sum()), 3))
    feet[:, plane.view.across], feet[:, plane.view.up] = across[columns[inside]], up[rows[inside]]
    for colour, width in (("#000000", 0.028), ("#ffffff", 0.014)):  # white arrows with a dark rim
        _arrows(axes, plane, feet, factor * way[inside], (colour, 0.5 * width if small else width), "layer-motion")


def points_chart(figure: Figure, data: ReportData, plane: Plane, state: MeasuredState) -> str:
    """The outlines at rest and fitted, and arrows of the measured and the fitted motion near the plane."""
    reference, axes, near = data.references[state.reference], _fill(figure, plane), 0
    show_shades(axes, plane, shades_of(data, reference.background, plane))
    draw_outlines(axes, data, plane, reference.surfaces, state.outlines)
    for of in state.points:
        here = np.abs(of.rest[:, plane.view.normal] - plane.position) <= of.near_mm
        near += int(np.count_nonzero(here))
        _arrows(axes, plane, of.rest[here], state.motion_factor * of.observed[here], SEEN, "layer-seen")
        _arrows(axes, plane, of.rest[here], state.motion_factor * of.fitted[here], FITTED, "layer-fitted")
    furnish(axes, plane)
    return f"{_where(plane)}: measured and fitted motion of {near} points near it, as arrows."


def alignment_chart(figure: Figure, data: ReportData, plane: Plane, later: LaterImage) -> str:
    """The earlier image in cyan over the later one in red, so that what agrees is grey; `ValueError` without both."""
    if len(later.both) != 2:
        raise ValueError("there are no images to be compared")
    axes, (first, second) = _fill(figure, plane), (_brightness(data, volume, plane) for volume in later.both)
    show_shades(axes, plane, np.stack([second, first, first], axis=2))
    furnish(axes, plane)
    reference = data.references[later.reference].name
    return f"{plane.view.name.capitalize()} slice: {reference} in cyan over {later.name} in red; what agrees is grey."


def _where(plane: Plane) -> str:
    """Which slice it is, in words."""
    return f"{plane.view.name.capitalize()} slice at {'xyz'[plane.view.normal]} = {plane.position:.0f} mm"


def _fill(figure: Figure, plane: Plane) -> Axes:
    """Axes that fill the figure, which is made as large as a picture of the plane."""
    across, up = (float(plane.high[axis] - plane.low[axis]) for axis in (plane.view.across, plane.view.up))
    figure.set_layout_engine("none")
    figure.set_size_inches(WIDTH_INCHES, WIDTH_INCHES * up / across)
    return figure.add_axes((0, 0, 1, 1))


def furnish(axes: Axes, plane: Plane, *, small: bool = False) -> None:
    """Letters of the sides, a bar of millimetres, and where the plane lies.

    small: in a figure for paper, whose title tells where it lies.
    """
    view, size = plane.view, 6.0 if small else 8.0
    axes.set_xlim(plane.high[view.across], plane.low[view.across])
    axes.set_ylim(plane.low[view.up], plane.high[view.up])
    axes.set_axis_off()
    edge = 0.04 if small else 0.025
    places = ((edge, 0.5), (1.0 - edge, 0.5), (0.5, 0.97 - edge + 0.025), (0.5, 0.03 + edge - 0.025))
    for letter, (x, y) in zip(view.letters, places, strict=True):
        _write(axes, x, y, letter, ha="center", va="center", fontweight="bold", fontsize=size + 1.0)
    if not small:
        where = f"{'xyz'[view.normal]} = {plane.position:.0f} mm"
        _write(axes, 0.975, 0.03, where, ha="right", va="center", fontsize=7)
    width = float(plane.high[view.across] - plane.low[view.across])
    bar = next(size for size in (50.0, 20.0, 10.0, 5.0, 1.0, 0.0) if size < 0.4 * width)
    left, bottom = plane.high[view.across] - 0.06 * width, plane.low[view.up] + 0.06 * width
    stroke = [withStroke(linewidth=3.4, foreground="#000000")]
    ends = [left, left - bar]
    wide = 1.2 if small else 2.0
    axes.plot(ends, [bottom] * 2, color="white", linewidth=wide, solid_capstyle="butt", path_effects=stroke)
    place = (left, bottom + 0.015 * width)
    axes.text(*place, f"{bar:g} mm", color="white", ha="left", va="bottom", fontsize=size, path_effects=OUTLINE)


def show_shades(axes: Axes, plane: Plane, shades: NDArray[np.float64]) -> None:
    """Draw colours (n_up, n_across, 3), 0 to 1, where the plane lies."""
    across, up = plane.axes
    axes.imshow(shades, extent=(across[0], across[-1], up[0], up[-1]), origin="lower", interpolation="none")


def shades_of(
    data: ReportData, volume: Volume | None, plane: Plane, *, points: NDArray[np.float64] | None = None
) -> NDArray[np.float64]:
    """Colours (n_up, n_across, 3), 0 to 1, of a volume on a plane: greys in its window, dark tissues, or black.

    points (n_up, n_across, 3) RAS mm: what the pixels show, in the place of the plane's points.
    """
    if volume is None:
        return np.zeros((*plane.points.shape[:2], 3))
    if volume.kind == "grey":
        return np.repeat(_brightness(data, volume, plane, points)[..., None], 3, axis=2)
    colours = [(0.0, 0.0, 0.0), *(0.06 + 0.3 * np.array(to_rgb(tissue.colour)) for tissue in data.tissues)]
    steps = np.nan_to_num(cut_image(volume.values, volume.grid, plane, order=0, points=points))
    return np.asarray(np.array(colours)[np.rint(steps).astype(int)])


def coloured(
    shades: NDArray[np.float64], values: NDArray[np.float64], scale: Scale, *, full: float = 0.0
) -> NDArray[np.float64]:
    """Shades (n_up, n_across, 3) under the colours of values (n_up, n_across), in the scale's unit; NaN: left as is.

    full: from which part of the scale on the colours are as strong as they get; below it they fade.
    """
    colours = scale.colours(values.ravel()).reshape(shades.shape)
    strength = np.ones(values.shape)
    if full:
        strength = np.clip(scale.place(values.ravel()).reshape(values.shape) / full, 0.0, 1.0)
    share = np.where(np.isfinite(values), OPACITY * strength, 0.0)[..., None]
    return np.asarray((1.0 - share) * shades + share * colours)


def _arrows(
    axes: Axes,
    plane: Plane,
    rest: NDArray[np.floating],
    way: NDArray[np.floating],
    style: tuple[str, float],
    gid: str,
) -> None:
    """Arrows from points (n, 3) mm along (n, 3) mm, as they lie in the plane."""
    if len(rest):
        places = [of[:, axis] for of in (rest, way) for axis in (plane.view.across, plane.view.up)]
        options = {"angles": "xy", "scale_units": "xy", "scale": 1.0, "units": "inches", "minlength": 0.5}
        axes.quiver(*places, color=style[0], width=style[1], zorder=3.0, **options).set_gid(gid)


def _brightness(
    data: ReportData, volume: Volume, plane: Plane, points: NDArray[np.float64] | None = None
) -> NDArray[np.float64]:
    """Brightness (n_up, n_across), 0 to 1: of a volume's greys in its window, or of its tissues by their role.

    points (n_up, n_across, 3) RAS mm: as in `shades_of`.
    """
    if volume.kind == "grey":
        return volume.shade(np.nan_to_num(cut_image(volume.values, volume.grid, plane, points=points)))
    levels = np.array([0.0, *(ROLE_LEVELS[tissue.role] for tissue in data.tissues)])
    steps = np.nan_to_num(cut_image(volume.values, volume.grid, plane, order=0))
    return np.asarray(levels[np.rint(steps).astype(int)])


def draw_lines(axes: Axes, data: ReportData, plane: Plane, surface: TriangleSurface, *, gid: str, **style: Any) -> None:
    """Where a surface crosses the plane, in its tissue's colour unless `style` says otherwise."""
    lines = joined(surface.points.astype(np.float64), surface.triangles.astype(np.int64), plane)
    collection = LineCollection(
        lines, **{"colors": [data.tissues[surface.tissue].colour], "capstyle": "round", "joinstyle": "round"} | style
    )
    collection.set_gid(gid)
    axes.add_collection(collection, autolim=False)


def _write(axes: Axes, x: float, y: float, text: str, **style: Any) -> None:
    axes.text(x, y, text, transform=axes.transAxes, color="white", path_effects=OUTLINE, **style)
