"""Maps of stiffness on the page: three slices of a tissue, each beside its standard deviation, and the tissue cut open.

Where the data removed less than half of what was not known, a slice is hatched and shows the tissue's mean.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure
from numpy.typing import NDArray

from palpate.mesh.locate import located
from palpate.report.pictures import BESIDE_FRONT, HEIGHT, WIDTH, face_normals, section_faces
from palpate.report.render import Triangles, render_png
from palpate.report.report_data import MapSlice, ReportData, TissueMap
from palpate.report.scales import Scale, draw_colour_bar, shown_stiffness
from palpate.report.section import VIEWS, Plane
from palpate.report.svg import INK
from palpate.statement.map_summary import RESOLVED, map_summary
from palpate.statement.result import CaseResult
from palpate.statement.stiffness_scale import StiffnessScale

ROOM_MM = 3.0  # round the tissue
COLOURS = "cividis"  # which is read alike by who sees no red or green
FACTORS, DECADE, CLOSE = (1.0, 1.2, 1.5, 2.0, 3.0, 5.0), (1.0, 2.0, 5.0, 10.0, 20.0, 50.0, 100.0), 5.0
SIDE_INCHES = 1.9


def tissue_maps(result: CaseResult) -> tuple[TissueMap, ...]:
    """The maps of the first reference state, cut through the region that differs, or the tissue's middle."""
    mesh, found = result.space.mesh, list[TissueMap]()
    for of in (of for of in result.estimation.maps if of.state < len(result.pairs[0].later)):
        tissue = mesh.tissue_index(of.tissue)
        corners = mesh.nodes[mesh.tets[of.elements]].reshape(-1, 3)
        low, high = corners.min(axis=0) - ROOM_MM, corners.max(axis=0) + ROOM_MM
        middle = 0.5 * (low + high) if of.region is None else of.region.centre_mm
        mean, row = float(result.stiffness[tissue]), np.full(len(mesh.tets), -1, dtype=np.int64)
        row[of.elements] = np.arange(len(of.elements))
        shown = mean * np.exp(np.where(of.resolution < RESOLVED, 0.0, of.log_ratio))
        slices = list[MapSlice]()
        for view in VIEWS:
            plane = Plane(view, float(middle[view.normal]), low, high)
            tets = located(mesh, plane.points.reshape(-1, 3)).tet
            rows = np.where(tets < 0, -1, row[tets])
            fields = (np.append(values, np.nan)[rows] for values in (shown, of.sd, of.resolution))
            slices.append(MapSlice(*(field.reshape(plane.points.shape[:2]).astype(np.float32) for field in fields)))
        cut = low, high, middle, tuple(slices)
        elements = of.elements.astype(np.int32), shown.astype(np.float32)
        found.append(TissueMap(tissue, map_summary(of), mean, *cut, *elements))
    return tuple(found)


def map_scale(of: TissueMap, shown: StiffnessScale) -> Scale:
    """Moduli of a map, logarithmic, as far below its tissue's mean as above it, and by a factor of 1.5 at least.

    shown: the unit in which the case's moduli are shown.
    """
    mean = shown.factor * of.mean
    factor = max(1.5, *np.exp(np.abs(np.log(np.quantile(of.moduli, [0.005, 0.995]) / of.mean))).tolist())
    ends = (mean / factor, mean, mean * factor)
    return Scale(COLOURS, ends[0], ends[2], True, shown.label, tuple((end, f"{end:.3g}") for end in ends))


def map_chart(figure: Figure, data: ReportData, of: TissueMap) -> str:
    """Slices of a map, beside each the factor e^sd by which its modulus may be off, and a colour bar under each column.

    A length of the one colour bar is the same factor as on the other.
    """
    figure.set_size_inches(2.0 * SIDE_INCHES + 0.6, 3.0 * SIDE_INCHES + 1.2)
    shown = shown_stiffness(data)
    scale = map_scale(of, shown)
    spread = Scale(COLOURS, 1.0, scale.high / scale.low, True, "factor of one standard deviation", ())
    figure.set_layout_engine("none")  # the columns are as wide as each other
    axes = figure.subplots(3, 2, gridspec_kw={"left": 0.02, "right": 0.98, "top": 0.94, "bottom": 0.14})
    for row, (view, cut) in enumerate(zip(VIEWS, of.slices, strict=True)):
        plane = Plane(view, float(of.position[view.normal]), of.low, of.high)
        _slice(axes[row, 0], plane, cut, shown.factor * cut.modulus, scale)
        _slice(axes[row, 1], plane, cut, np.exp(cut.sd), spread)
        axes[row, 0].set_title(f"{view.name}, {'xyz'[view.normal]} = {plane.position:.0f} mm", loc="left")
    for column, of_column in enumerate((scale, spread)):
        factors = FACTORS if of_column.high < CLOSE else DECADE
        places = [place for place, _ in of_column.ticks] or [f for f in factors if f <= of_column.high]
        marked = replace(of_column, ticks=tuple((place, f"{place:.3g}") for place in places))
        draw_colour_bar(figure.add_axes(((0.06 + 0.5 * column), 0.075, 0.38, 0.02)), marked)
    return f"Slices of the modulus inside {data.tissues[of.tissue].name}, and of its standard deviation. {of.words}"


def _slice(axes: Axes, plane: Plane, cut: MapSlice, values: NDArray[np.float32], scale: Scale) -> None:
    across, up = plane.axes
    shades = np.ma.masked_invalid(values.astype(np.float64))
    extent = (float(across[0]), float(across[-1]), float(up[0]), float(up[-1]))
    limits = LogNorm(scale.low, scale.high)
    axes.imshow(shades, extent=extent, origin="lower", interpolation="none", norm=limits, cmap=scale.name)
    blind = np.where(np.isfinite(cut.resolution), cut.resolution < RESOLVED, False).astype(np.float64)
    if blind.any():
        drawn = axes.contourf(across, up, blind, levels=[0.5, 1.5], colors="none", hatches=["////"])
        drawn.set_edgecolor("#ffffff")
        drawn.set_linewidth(0.0)
    inside = np.isfinite(cut.resolution).astype(np.float64)
    if inside.any():
        axes.contour(across, up, inside, levels=[0.5], colors=[INK], linewidths=0.8)
    axes.set_xlim(across[-1], across[0])  # the patient's right is on the left
    axes.set_aspect("equal")
    axes.set_axis_off()


def map_png(data: ReportData, of: TissueMap) -> bytes:
    """The mapped tissue cut open through the slices' sagittal plane, coloured by modulus as these are; PNG."""
    if data.mesh is None:
        raise ValueError("there is no mesh")
    mesh = data.mesh
    faces, tets = section_faces(replace(mesh, tets=mesh.tets[of.elements]), axis=0, position=float(of.position[0]))
    corners = mesh.nodes.astype(np.float64)[faces]
    shown = shown_stiffness(data)
    moduli = shown.factor * of.moduli[tets].astype(np.float64)
    colours = np.repeat(map_scale(of, shown).colours(moduli)[:, None], 3, axis=1)
    normals = np.repeat(face_normals(corners)[:, None], 3, axis=1)
    return render_png(Triangles(corners, colours, normals), BESIDE_FRONT, width=WIDTH, height=HEIGHT)
