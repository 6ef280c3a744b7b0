"""Three slices beside each other, to one scale: contours before and after, Young's modulus, displacement."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patheffects import withStroke

from palpate.report.figures.sheet import MM, PAGE_MM, size_mm
from palpate.report.report_data import LaterImage, ReportData, Volume
from palpate.report.scales import Scale, displacement_scale, draw_colour_bar, modulus_scale
from palpate.report.section import Plane
from palpate.report.slices import (
    DOTTED,
    LEAST_ARROW_MM,
    arrow_factor,
    contour_names,
    first_planes,
    longer,
    paint_contours,
    paint_displacement,
    paint_stiffness,
)

GAP_MM, EDGE_MM, TITLE_MM, LEGEND_MM, BAR_MM = 2.0, 1.0, 6.0, 6.0, 15.0
BAR_LEFT_MM = 40.0
DARK = (withStroke(linewidth=4.0, foreground="#333333"),)  # under a white line on a white sheet
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


def colour_bar(figure: Figure, scale: Scale) -> None:
    """A horizontal bar of a scale's colours with its ticks and its label, 3 mm high, at the bottom of a sheet."""
    wide, tall = (25.4 * size for size in figure.get_size_inches())
    draw_colour_bar(
        figure.add_axes((BAR_LEFT_MM / wide, 9.5 / tall, 1.0 - 2.0 * BAR_LEFT_MM / wide, 3.0 / tall)), scale
    )


def legend(figure: Figure, data: ReportData, *, bottom_mm: float) -> None:
    """The tissues whose contours are drawn, by colour, in one row."""
    names = [Line2D([], [], color=colour, linewidth=2.0, label=name[:24]) for name, colour in contour_names(data)]
    _row_of(figure, names, bottom_mm=bottom_mm, ncols=8, handlelength=1.6)


def _row_of(figure: Figure, lines: Sequence[Line2D], *, bottom_mm: float, **style: float) -> None:
    place = (0.5, bottom_mm * MM / figure.get_figheight())
    options: dict[str, Any] = {"frameon": False, "columnspacing": 1.2, "borderaxespad": 0.0, **style}
    figure.legend(handles=list(lines), loc="lower center", bbox_to_anchor=place, **options)


def stiffness_sheet(figure: Figure, data: ReportData) -> str:
    """Young's modulus over the first image; raises `ValueError` where there is no mesh, no modulus or no slice."""
    scale, reference = modulus_scale(data), data.references[0]
    _in_colours(figure, data, scale, partial(paint_stiffness, data=data))
    return (
        f"Estimated Young's modulus over {reference.name}, in axial, coronal and sagittal slices. Only organs whose"
        " modulus was estimated are coloured; lines are the contours of the segmentation. The colours show"
        f" {scale.label} on a logarithmic scale. {RADIOLOGICAL}"
    )


def displacement_sheet(figure: Figure, data: ReportData, later: LaterImage) -> str:
    """The fitted motion to a later image of the first pair; raises `ValueError` where none is kept."""
    factor, name = arrow_factor(later), data.references[0].name
    _in_colours(figure, data, displacement_scale(later), partial(paint_displacement, data=data, later=later))
    return (
        f"Length of the fitted motion from {name} to {later.name}, in mm, over {name}. Arrows show"
        f" the part of the motion in the slice and are drawn {longer(factor)}. Arrows shorter than {LEAST_ARROW_MM} mm"
        f" in the drawing are left out. Colours fade where hardly anything moves. {RADIOLOGICAL}"
    )


def _in_colours(figure: Figure, data: ReportData, scale: Scale, paint: Callable[..., None]) -> None:
    """What `paint` draws on three slices of the first image, over a legend and the bar of its colours."""
    strip = strip_of(data)
    size_mm(figure, PAGE_MM, TITLE_MM + max(strip.heights_mm) + LEGEND_MM + BAR_MM)
    for axes, plane in zip(strip.axes(figure, bottom_mm=BAR_MM + LEGEND_MM), strip.planes, strict=True):
        paint(axes, plane=plane, small=True)
    legend(figure, data, bottom_mm=BAR_MM + 1.0)
    colour_bar(figure, scale)


def before_after_sheet(figure: Figure, data: ReportData, later: LaterImage) -> str:
    """Contours of both images and of the fitted model, over the earlier image, and over the later one where it is grey.

    Raises `ValueError` where there are no slices.
    """
    strip, reference = strip_of(data, later.reference), data.references[later.reference]
    rows: list[tuple[str, Volume | None]] = [(reference.name, reference.background)]
    if later.background is not None and later.background.kind == "grey":
        rows.append((later.name, later.background))
    tall = max(strip.heights_mm) + TITLE_MM
    size_mm(figure, PAGE_MM, len(rows) * tall + 2.0 * LEGEND_MM)
    for row, (_, volume) in enumerate(reversed(rows)):
        for axes, plane in zip(strip.axes(figure, bottom_mm=2.0 * LEGEND_MM + row * tall), strip.planes, strict=True):
            paint_contours(axes, data, plane, later, volume, small=True)
    legend(figure, data, bottom_mm=LEGEND_MM + 1.0)
    lines = (
        Line2D([], [], color="#666666", linestyle=DOTTED, linewidth=1.0, label=f"{reference.name[:32]} (dotted)"),
        Line2D([], [], color="#666666", linewidth=4.0, alpha=0.5, label=f"{later.name[:32]} (broad)"),
        Line2D([], [], color="white", linewidth=1.0, label="fitted model (thin, white)", path_effects=DARK),
    )
    _row_of(figure, lines, bottom_mm=1.0, ncols=3, handlelength=2.4)
    over = " and ".join(name for name, _ in rows)
    return (
        f"Contours over {over}: dotted in {reference.name}, broad in {later.name}, and thin white as the fitted model"
        f" moves those of {reference.name}. Where the white line runs inside the broad one, the model explains the"
        f" motion. {RADIOLOGICAL}"
    )
