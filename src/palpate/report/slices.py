"""Three orthogonal slices with the organs' contours before, after and in the fitted model."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from matplotlib.patheffects import withStroke
from numpy.typing import NDArray

from palpate.images.distance import smoothing_width
from palpate.images.label_image import VoxelGrid
from palpate.images.segmentation import Segmentation
from palpate.images.tissue import Role
from palpate.mesh.surface import tissue_surface
from palpate.report.colours import tissue_colours
from palpate.report.section import VIEWS, Plane, cut_image, cut_surface, cut_tissue
from palpate.report.svg import draw_svg
from palpate.study.result import CaseResult

__all__ = ["GreyImage", "choose_planes", "contour_names", "slice_svg"]

GreyImage = tuple[NDArray[np.float32], VoxelGrid]

MARGIN_MM = 15.0
WIDTH_INCHES = 4.6
CT_WINDOW = (-160.0, 240.0)  # Hounsfield units in which soft tissues differ
OUTLINE = (withStroke(linewidth=1.5, foreground="#000000", alpha=0.7),)  # letters stay readable on bright bone
FOUR = np.array([[0, 3, 5], [3, 1, 4], [5, 4, 2], [3, 4, 5]])  # a 6-point triangle as four of three


@dataclass(frozen=True, slots=True)
class _Contours:
    """What is drawn of one later image: its number, the tissues (indices), the width of the smoothing (mm)."""

    after: int
    tissues: tuple[int, ...]
    smoothing_mm: float


def choose_planes(result: CaseResult) -> tuple[Plane, ...]:
    """An axial, a coronal and a sagittal plane that show as much as possible of all estimated tissues and drivers."""
    box = [_extent(result.before, _moving(result)), *(_extent(image, _moving(result)) for image in result.after)]
    border = np.array([_range(result.before.grid, axis) for axis in range(3)])
    low = np.maximum(np.min([pair[0] for pair in box], axis=0) - MARGIN_MM, border[:, 0])
    high = np.minimum(np.max([pair[1] for pair in box], axis=0) + MARGIN_MM, border[:, 1])
    return tuple(Plane(view, _richest(result, view.normal), low, high) for view in VIEWS)


def contour_names(result: CaseResult) -> tuple[tuple[str, str], ...]:
    """(name, colour) of every tissue whose contour is drawn."""
    colours = tissue_colours(result.tissues)
    return tuple((result.tissues[i].name, colours[i]) for i in (*_moving(result), *_rigid(result)))


def slice_svg(result: CaseResult, plane: Plane, *, after: int, grey: GreyImage | None, name: str) -> str:
    """One slice as SVG: `grey` image (else the tissues' colours) under the contours of later image number `after`."""
    across, up = (float(plane.high[axis] - plane.low[axis]) for axis in (plane.view.across, plane.view.up))
    grids = [result.before.grid, result.after[after].grid]
    contours = _Contours(after, (*_moving(result), *_rigid(result)), smoothing_width(*grids))

    def draw(figure: Figure) -> None:
        axes = figure.add_axes((0, 0, 1, 1))
        _background(axes, result, plane, grey=grey)
        _draw_contours(axes, result, plane, contours=contours)
        _furniture(axes, plane)

    return draw_svg(draw, size=(WIDTH_INCHES, WIDTH_INCHES * up / across), name=name)


def _moving(result: CaseResult) -> tuple[int, ...]:
    return tuple(i for i, t in enumerate(result.tissues) if t.role in (Role.ESTIMATE, Role.DRIVER))


def _rigid(result: CaseResult) -> tuple[int, ...]:
    return tuple(i for i, t in enumerate(result.tissues) if t.role is Role.RIGID)


def _extent(image: Segmentation, tissues: tuple[int, ...]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Corners (3,) mm of the box around the tissues' voxels; the whole image when there are none."""
    index = np.argwhere(np.isin(image.index, tissues)).astype(np.float64)
    if not len(index):
        index = np.array([[0.0, 0.0, 0.0], [*image.grid.shape]])
    points = image.grid.world(index)
    return points.min(axis=0), points.max(axis=0)


def _richest(result: CaseResult, axis: int) -> float:
    """Position (mm) along a world axis that shows much of every tissue, each measured by its own largest section."""
    grid = result.before.grid
    low, high = _range(grid, axis)
    bins = np.linspace(low, high, max(round((high - low) / float(grid.spacing.max())), 1) + 1)
    score = np.zeros(len(bins) - 1)
    for tissue in _moving(result):
        places = grid.world(np.argwhere(result.before.index == tissue).astype(np.float64))[:, axis]
        area = np.histogram(places, bins)[0]
        weight = 3.0 if result.tissues[tissue].role is Role.ESTIMATE else 1.0
        score += weight * np.log(0.03 + area / max(area.max(), 1))  # what is absent costs more than what is small
    best = int(np.argmax(score))
    return float(0.5 * (bins[best] + bins[best + 1]))


def _range(grid: VoxelGrid, axis: int) -> tuple[float, float]:
    """Outer faces of the grid along a world axis, mm."""
    corners = np.array(np.meshgrid(*[[-0.5, n - 0.5] for n in grid.shape])).reshape(3, -1).T
    places = grid.world(corners)[:, axis]
    return float(places.min()), float(places.max())


def _background(axes: Axes, result: CaseResult, plane: Plane, *, grey: GreyImage | None) -> None:
    across, up = plane.axes
    extent = (across[0], across[-1], up[0], up[-1])
    if grey is not None:
        picture = cut_image(grey[0], grey[1], plane)
        low, high = _grey_window(picture)
        axes.imshow(picture, cmap="gray", vmin=low, vmax=high, extent=extent, origin="lower", interpolation="none")
        return
    colours = np.array([*(to_rgb(colour) for colour in tissue_colours(result.tissues)), (0.0, 0.0, 0.0)])
    dimmed = np.where(np.arange(len(colours))[:, None] < len(result.tissues), 0.06 + 0.3 * colours, 0.0)
    number = cut_image(result.before.index, result.before.grid, plane, order=0)
    picture = dimmed[np.nan_to_num(number, nan=-1.0).astype(np.int64)]
    axes.imshow(picture, extent=extent, origin="lower", interpolation="none")


def _grey_window(picture: NDArray[np.float64]) -> tuple[float, float]:
    """Grey values shown black and white: a soft-tissue window for a CT, else the middle 98 percent."""
    finite = picture[np.isfinite(picture)]
    if not len(finite):
        return 0.0, 1.0
    if finite.min() < -500.0:
        return CT_WINDOW
    low, high = np.percentile(finite, [1.0, 99.0])
    return float(low), float(max(high, low + 1e-6))


def _draw_contours(axes: Axes, result: CaseResult, plane: Plane, *, contours: _Contours) -> None:
    colours = tissue_colours(result.tissues)
    images = (
        ("layer-after", result.after[contours.after], 4.0, "solid", 0.5),
        ("layer-before", result.before, 1.0, (0, (1, 1.6)), 1.0),
    )
    for tissue in contours.tissues:
        for gid, image, width, style, alpha in images:
            share = cut_tissue(image, tissue, plane, smoothing_mm=contours.smoothing_mm)
            if share.min() < 0.5 < share.max():
                drawn = axes.contour(
                    *plane.axes, share, levels=[0.5], colors=[colours[tissue]], linewidths=width, alpha=alpha
                )
                drawn.set_linestyle(style)
                drawn.set_gid(gid)
        segments = _model_section(result, tissue, plane, after=contours.after)
        lines = LineCollection(list(segments), colors=["white"], linewidths=1.0, capstyle="round")
        lines.set_gid("layer-model")
        axes.add_collection(lines, autolim=False)


def _model_section(result: CaseResult, tissue: int, plane: Plane, *, after: int) -> NDArray[np.float64]:
    """Segments (n, 2, 2) mm in which the plane cuts the tissue's deformed surface."""
    space = result.space
    triangles = tissue_surface(space.mesh, tissue).triangles
    if after >= len(result.estimation.displacements) or not len(triangles):
        return np.zeros((0, 2, 2))
    facets = space.facets(triangles)
    flat = facets if space.order == 1 else facets[:, FOUR].reshape(-1, 3)
    return cut_surface(space.points + result.estimation.displacements[after], flat, plane)


def _furniture(axes: Axes, plane: Plane) -> None:
    """Limits (the patient's right on the left), orientation letters, scale bar."""
    view = plane.view
    axes.set_xlim(plane.high[view.across], plane.low[view.across])
    axes.set_ylim(plane.low[view.up], plane.high[view.up])
    axes.set_axis_off()
    places = ((0.025, 0.5), (0.975, 0.5), (0.5, 0.97), (0.5, 0.03))
    for letter, (x, y) in zip(view.letters, places, strict=True):
        axes.text(
            x,
            y,
            letter,
            transform=axes.transAxes,
            color="white",
            ha="center",
            va="center",
            fontweight="bold",
            path_effects=OUTLINE,
        )
    width = float(plane.high[view.across] - plane.low[view.across])
    bar = next(size for size in (50.0, 20.0, 10.0, 5.0, 1.0, 0.0) if size < 0.4 * width)
    left, bottom = plane.high[view.across] - 0.06 * width, plane.low[view.up] + 0.06 * width
    axes.plot(
        [left, left - bar],
        [bottom, bottom],
        color="white",
        linewidth=2.0,
        solid_capstyle="butt",
        path_effects=(withStroke(linewidth=3.4, foreground="#000000"),),
    )
    axes.text(
        left,
        bottom + 0.015 * width,
        f"{bar:g} mm",
        color="white",
        ha="left",
        va="bottom",
        fontsize=8,
        path_effects=OUTLINE,
    )
    axes.text(
        0.975,
        0.03,
        f"{'xyz'[view.normal]} = {plane.position:.0f} mm",
        transform=axes.transAxes,
        color="white",
        ha="right",
        va="center",
        fontsize=7,
        path_effects=OUTLINE,
    )
