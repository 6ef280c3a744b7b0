"""The fitted motion as an animation: the earlier image carried along by the model, with its contours."""

from __future__ import annotations

import io
from collections.abc import Sequence

import matplotlib as mpl
import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from numpy.typing import NDArray
from PIL import Image

from palpate.report.cut_mesh import cut_mesh, motion_of
from palpate.report.figures.sheet import MM, PAGE_MM, STYLE
from palpate.report.figures.slices import LEGEND_MM, TITLE_MM, legend, strip_of
from palpate.report.report_data import LaterImage, ReportData, TriangleSurface, Volume
from palpate.report.section import Plane
from palpate.report.slices import draw_lines, furnish, shades_of, show_shades

STEPS = 12  # from the earlier image to the later one
FRAME_MS, REST_MS = 80, 900  # of a frame, and of the first and the last
PIXELS = 850  # across
MOST_COLOURS = 256  # of a GIF
UNKNOWN = 0.08  # brightness of what the motion uncovers, of which nothing is known


def motion_gif(data: ReportData, later: LaterImage) -> bytes:
    """The motion to a later image there and back, as GIF; raises `ValueError` where none is kept."""
    reference, motion, strip = data.references[later.reference], motion_of(later), strip_of(data, later.reference)
    surfaces = {surface.tissue: surface for surface in reference.surfaces}
    moving = [
        (surfaces[outline.tissue], outline)
        for outline in later.outlines
        if outline.tissue in surfaces and len(surfaces[outline.tissue].points) == len(outline.points)
    ]
    still = [surface for surface in reference.surfaces if surface.tissue not in {end.tissue for _, end in moving}]
    frames = list[Image.Image]()
    for share in np.linspace(0.0, 1.0, STEPS + 1).tolist():
        with mpl.rc_context(STYLE):
            height = TITLE_MM + max(strip.heights_mm) + LEGEND_MM
            figure = Figure(figsize=(PAGE_MM * MM, height * MM), dpi=PIXELS / (PAGE_MM * MM))
            carried = [
                TriangleSurface(end.tissue, ((1.0 - share) * start.points + share * end.points), end.triangles)
                for start, end in moving
            ]
            for axes, plane in zip(strip.axes(figure, bottom_mm=LEGEND_MM), strip.planes, strict=True):
                show_shades(axes, plane, _carried(data, reference.background, plane, share * motion))
                for surface in (*still, *carried):
                    draw_lines(axes, data, plane, surface, gid="model", linewidth=1.0)
                furnish(axes, plane, small=True)
            legend(figure, data, bottom_mm=1.0)
            words = f"{round(100 * share)} % of the fitted motion"
            figure.text(0.99, 0.99, words, ha="right", va="top", fontsize=7.5)
            canvas = FigureCanvasAgg(figure)
            canvas.draw()
        frames.append(Image.fromarray(np.asarray(canvas.buffer_rgba())[..., :3].copy()))
    # one palette for all frames, or still parts would flicker
    palette = _palette([tissue.colour for tissue in data.tissues])
    flat = [frame.quantize(palette=palette, dither=Image.Dither.NONE) for frame in frames]
    there_and_back = [*flat, *flat[-2:0:-1]]
    times = [FRAME_MS] * len(there_and_back)
    times[0] = times[STEPS] = REST_MS
    memory = io.BytesIO()
    there_and_back[0].save(
        memory, format="GIF", save_all=True, append_images=there_and_back[1:], duration=times, loop=0, optimize=False
    )
    return memory.getvalue()


def _palette(colours: Sequence[str]) -> Image.Image:
    """Greys, and the tissues' colours with some of the greys mixed in, as the palette of an image."""
    greys = np.linspace(0.0, 1.0, 96)[:, None] * np.ones(3)
    own = np.array([to_rgb(colour) for colour in dict.fromkeys(colours)])
    shares = [share for share in (1.0, 0.75, 0.5, 0.25) for _ in (0.0, 1.0)]
    mixed = [s * own + (1.0 - s) * grey for s, grey in zip(shares, (0.0, 1.0) * 4, strict=True)]
    table = np.unique(np.rint(255.0 * np.concatenate([greys, *mixed])).astype(np.uint8), axis=0)[:MOST_COLOURS]
    palette = Image.new("P", (1, 1))
    palette.putpalette(table.ravel().tolist())
    return palette


def motion_caption(data: ReportData, later: LaterImage) -> str:
    """What the animation shows."""
    name = data.references[later.reference].name
    return (
        f"Animation of the fitted motion from {name} to {later.name} and back. It shows {name} and its contours as the"
        " fitted model moves them: the motion of the model, not a film of the body. The model has no tissue inside"
        " hollow organs; what the motion uncovers there is dark."
    )


def _carried(data: ReportData, volume: Volume | None, plane: Plane, motion: NDArray[np.float64]) -> NDArray[np.float64]:
    """Shades (n_up, n_across, 3) of the earlier image on a plane when its tissue has moved by (n_nodes, 3) mm."""
    shades = shades_of(data, volume, plane)
    if volume is None or not motion.any():
        return shades
    now, rest = cut_mesh(data, plane, motion=motion), cut_mesh(data, plane)
    came_from = plane.points - np.nan_to_num(now.of_nodes(motion))
    carried = shades_of(data, volume, plane, points=came_from)
    shown = np.where(now.inside[..., None], carried, shades)
    return np.asarray(np.where((rest.inside & ~now.inside)[..., None], UNKNOWN, shown))
