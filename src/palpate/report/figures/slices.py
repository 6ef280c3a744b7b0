"""Three slices beside each other, to one scale: contours before and after, Young's modulus, displacement."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import LogNorm, Normalize
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patheffects import withStroke
from matplotlib.ticker import FixedFormatter, FixedLocator, NullLocator
from numpy.typing import NDArray

from palpate.report.figures.sheet import PAGE_MM, Sheet
from palpate.report.report_data import ReportData, Volume
from palpate.report.scales import Scale, displacement_scale, modulus_scale
from palpate.report.section import Plane
from palpate.report.slices import (
    FADED,
    LEAST_ARROW_MM,
    arrow_factor,
    coloured,
    contour_names,
    draw_lines,
    first_planes,
    furnish,
    motion_arrows,
    motion_on,
    shades_of,
    show_shades,
    stiffness_on,
)

GAP_MM, EDGE_MM, TITLE_MM, LEGEND_MM, BAR_MM = 2.0, 1.0, 6.0, 6.0, 15.0
DARK = (withStroke(linewidth=4.0, foreground="#333333"),)  # under a white line on a white sheet
DOTTED = (0, (1, 1.6))
RADIOLOGICAL = "The patient's right is on the left of axial and coronal slices."


@dataclass(frozen=True, slots=True)
class Strip:
    """Three planes side by side in a row of `PAGE_MM`, all to one scale."""

    planes: tuple[Plane, ...]

    @property
    def widths_mm(self) -> tuple[float, ...]:
        """Of the pictures on the sheet."""
        sizes = [float(plane.high[plane.view.across] - plane.low[plane.view.across]) for plane in self.planes]
        return tuple((PAGE_MM - 2.0 * EDGE_MM - GAP_MM * (len(sizes) - 1)) * size / sum(sizes) for size in sizes)

    @property
    def heights_mm(self) -> tuple[float, ...]:
        """Of the pictures on the sheet."""
        sides = ((plane.view.across, plane.view.up) for plane in self.planes)
        extents = [(plane.high - plane.low)[list(axes)] for plane, axes in zip(self.planes, sides, strict=True)]
        return tuple(width * float(up / across) for width, (across, up) in zip(self.widths_mm, extents, strict=True))

    def axes(self, figure: Figure, *, bottom_mm: float) -> tuple[Axes, ...]:
        """Axes of the pictures, aligned at their tops; the tallest one stands `bottom_mm` above the sheet's edge."""
        wide, tall = (25.4 * size for size in figure.get_size_inches())
        top, left, found = bottom_mm + max(self.heights_mm), EDGE_MM, list[Axes]()
        for plane, width, height in zip(self.planes, self.widths_mm, self.heights_mm, strict=True):
            axes = figure.add_axes((left / wide, (top - height) / tall, width / wide, height / tall))
            axes.set_title(
                f"{plane.view.name}, {'xyz'[plane.view.normal]} = {plane.position:.0f} mm", loc="left", pad=2.0
            )
            found.append(axes)
            left += width + GAP_MM
        return tuple(found)


def strip_of(data: ReportData, reference: int = 0) -> Strip:
    """The planes that the report opens with, of a reference state (its number); raises `ValueError` without slices."""
    box = data.references[reference].slices if reference < len(data.references) else None
    if box is None:
        raise ValueError("there are no slices of this image")
    return Strip(first_planes(box))


def _paint(axes: Axes, plane: Plane, shades: NDArray[np.float64]) -> None:
    """Shades (n_up, n_across, 3) on the plane, letters, and a bar of millimetres."""
    show_shades(axes, plane, shades)
    furnish(axes, plane, small=True)


def colour_bar(figure: Figure, scale: Scale, *, left_mm: float = 40.0, bottom_mm: float = 9.5) -> None:
    """A horizontal bar of a scale's colours with its ticks and its label, 3 mm high."""
    wide, tall = (25.4 * size for size in figure.get_size_inches())
    axes = figure.add_axes((left_mm / wide, bottom_mm / tall, (wide - 2.0 * left_mm) / wide, 3.0 / tall))
    limits = LogNorm(scale.low, scale.high) if scale.logarithmic else Normalize(scale.low, scale.high)
    bar = figure.colorbar(ScalarMappable(limits, scale.name), cax=axes, orientation="horizontal", label=scale.label)
    bar.ax.xaxis.set_major_locator(FixedLocator([place for place, _ in scale.ticks]))
    bar.ax.xaxis.set_major_formatter(FixedFormatter([label for _, label in scale.ticks]))
    bar.ax.xaxis.set_minor_locator(NullLocator())
    bar.outline.set_linewidth(0.5)


def legend(figure: Figure, data: ReportData, lines: Sequence[Line2D] = (), *, bottom_mm: float) -> None:
    """The tissues whose contours are drawn, by colour, and what kinds of lines there are, in one row."""
    names = [Line2D([], [], color=colour, linewidth=2.0, label=name[:24]) for name, colour in contour_names(data)]
    tall = 25.4 * figure.get_figheight()
    style = {"frameon": False, "ncols": 8, "handlelength": 1.6, "columnspacing": 1.2, "borderaxespad": 0.0}
    figure.legend(handles=[*names, *lines], loc="lower center", bbox_to_anchor=(0.5, bottom_mm / tall), **style)


def stiffness_sheet(data: ReportData) -> Sheet:
    """Young's modulus over the first image; raises `ValueError` where there is no mesh, no modulus or no slice."""
    strip, scale = strip_of(data), modulus_scale(data)
    reference = data.references[0]
    values = [stiffness_on(data, plane) for plane in strip.planes]

    def draw(figure: Figure) -> None:
        """Slices, contours, legend and colour bar."""
        for axes, plane, of in zip(strip.axes(figure, bottom_mm=BAR_MM + LEGEND_MM), strip.planes, values, strict=True):
            _paint(axes, plane, coloured(shades_of(data, reference.background, plane), of, scale))
            for surface in reference.surfaces:
                draw_lines(axes, data, plane, surface, gid="before", linewidth=0.8)
        legend(figure, data, bottom_mm=BAR_MM + 1.0)
        colour_bar(figure, scale)

    caption = (
        f"Estimated Young's modulus over {reference.name}, in axial, coronal and sagittal slices. Only organs whose"
        " modulus was estimated are coloured; lines are the contours of the segmentation. The colours show"
        f" {scale.label} on a logarithmic scale, from the softest to the stiffest tissue of the model. {RADIOLOGICAL}"
    )
    height = TITLE_MM + max(strip.heights_mm) + LEGEND_MM + BAR_MM
    return Sheet("stiffness-slices", caption, PAGE_MM, height, draw)


def displacement_sheet(data: ReportData, number: int) -> Sheet:
    """The fitted motion to a later image (its number); raises `ValueError` where none is kept."""
    later = data.later[number]
    strip, scale, factor = strip_of(data, later.reference), displacement_scale(later), arrow_factor(later)
    reference = data.references[later.reference]
    motions = [motion_on(data, plane, later) for plane in strip.planes]

    def draw(figure: Figure) -> None:
        """Slices, contours, arrows, legend and colour bar."""
        places = strip.axes(figure, bottom_mm=BAR_MM + LEGEND_MM)
        for axes, plane, motion in zip(places, strip.planes, motions, strict=True):
            lengths = np.linalg.norm(motion, axis=2)
            shades = shades_of(data, reference.background, plane)
            _paint(axes, plane, coloured(shades, lengths, scale, full=FADED))
            for surface in reference.surfaces:
                draw_lines(axes, data, plane, surface, gid="before", linewidth=0.8)
            motion_arrows(axes, plane, motion, factor, small=True)
        legend(figure, data, bottom_mm=BAR_MM + 1.0)
        colour_bar(figure, scale)

    longer = "as long as the motion" if factor == 1.0 else f"{factor:g} times as long as the motion"
    caption = (
        f"Length of the fitted motion from {reference.name} to {later.name}, in mm, over {reference.name}. Arrows show"
        f" the part of the motion in the slice and are drawn {longer}. Arrows shorter than {LEAST_ARROW_MM} mm in the"
        f" drawing are left out. Colours fade where hardly anything moves. {RADIOLOGICAL}"
    )
    height = TITLE_MM + max(strip.heights_mm) + LEGEND_MM + BAR_MM
    return Sheet(f"displacement-{number + 1}", caption, PAGE_MM, height, draw)


def before_after_sheet(data: ReportData, number: int) -> Sheet:
    """Contours of both images and of the fitted model, over the earlier image, and over the later one where it is grey.

    number: of the later image. Raises `ValueError` where there are no slices.
    """
    later = data.later[number]
    strip, reference = strip_of(data, later.reference), data.references[later.reference]
    rows: list[tuple[str, Volume | None]] = [(reference.name, reference.background)]
    if later.background is not None and later.background.kind == "grey":
        rows.append((later.name, later.background))
    tall = max(strip.heights_mm) + TITLE_MM
    styles = (
        Line2D([], [], color="#666666", linestyle=DOTTED, linewidth=1.0, label=f"{reference.name[:32]} (dotted)"),
        Line2D([], [], color="#666666", linewidth=4.0, alpha=0.5, label=f"{later.name[:32]} (broad)"),
        Line2D([], [], color="white", linewidth=1.0, label="fitted model (thin, white)", path_effects=DARK),
    )

    def draw(figure: Figure) -> None:
        """A row of slices for each image."""
        for row, (_, volume) in enumerate(rows):
            bottom = 2.0 * LEGEND_MM + (len(rows) - 1 - row) * tall
            for axes, plane in zip(strip.axes(figure, bottom_mm=bottom), strip.planes, strict=True):
                _paint(axes, plane, shades_of(data, volume, plane))
                for surface in later.surfaces:
                    draw_lines(axes, data, plane, surface, gid="after", linewidth=3.0, alpha=0.5)
                for surface in reference.surfaces:
                    draw_lines(axes, data, plane, surface, gid="before", linewidth=0.9, linestyle=DOTTED)
                for outline in later.outlines:
                    draw_lines(axes, data, plane, outline, gid="model", colors=["white"], linewidth=0.7)
        legend(figure, data, bottom_mm=LEGEND_MM + 1.0)
        style = {"frameon": False, "ncols": 3, "handlelength": 2.4, "borderaxespad": 0.0}
        figure.legend(
            handles=list(styles), loc="lower center", bbox_to_anchor=(0.5, 1.0 / 25.4 / figure.get_figheight()), **style
        )

    over = " and ".join(name for name, _ in rows)
    caption = (
        f"Contours over {over}: dotted in {reference.name}, broad in {later.name}, and thin white as the fitted model"
        f" moves those of {reference.name}. Where the white line runs inside the broad one, the model explains the"
        f" motion. {RADIOLOGICAL}"
    )
    return Sheet(f"before-after-{number + 1}", caption, PAGE_MM, len(rows) * tall + 2.0 * LEGEND_MM, draw)
