"""The organs' surfaces coloured by their distance to the later image, before and after the model was fitted."""

from __future__ import annotations

import io

import matplotlib.image as mpimg
import numpy as np
from matplotlib.figure import Figure

from palpate.report.figures.sheet import PAGE_MM, Sheet
from palpate.report.figures.slices import colour_bar
from palpate.report.pictures import organs_png
from palpate.report.report_data import ModelSurface, ReportData
from palpate.report.rows import number as text_of
from palpate.report.scales import distance_scale

HEIGHT_MM, BAR_MM, WORDS_MM, TITLE_MM = 58.0, 15.0, 3.6, 6.0
PIXELS = (1000, 690)  # of each picture


def residual_sheet(data: ReportData, number: int) -> Sheet:
    """The pair of pictures for a later image (its number); raises `ValueError` where there is no fitted model."""
    later = data.later[number]
    scale = distance_scale(data.references[later.reference].voxel_mm)
    pictures = [organs_png(data, later, fitted=fitted, size=PIXELS) for fitted in (False, True)]
    titles = (f"without a fit, to {later.name}", f"fitted to {later.name}")
    lines = [_words(data, model) for model in later.model]
    words = [line for line in lines if line]

    def draw(figure: Figure) -> None:
        """Two pictures, what they come to in numbers, and the colour bar."""
        tall = 25.4 * figure.get_figheight()
        bottom = BAR_MM + WORDS_MM * len(words) + 2.0
        for column, (png, title) in enumerate(zip(pictures, titles, strict=True)):
            axes = figure.add_axes((0.5 * column, bottom / tall, 0.5, HEIGHT_MM / tall))
            axes.imshow(mpimg.imread(io.BytesIO(png)))
            axes.set_axis_off()
            axes.set_title(title, loc="left", x=0.02, pad=2.0)
        for row, line in enumerate(words):
            figure.text(0.5, (bottom - 1.0 - WORDS_MM * (row + 0.5)) / tall, line, ha="center", va="center")
        colour_bar(figure, scale)

    caption = (
        f"Surfaces of the model, coloured by their signed distance to {later.name} in mm. Left: as they lie in the"
        " earlier image. Right: as fitted. Red parts stand out of the organ in the later image, blue parts stay inside"
        " it. Grey parts are not observed. The marks at one voxel show the length of its edge. The numbers are root"
        " mean squares over the observed surface."
    )
    height = TITLE_MM + HEIGHT_MM + WORDS_MM * len(words) + 2.0 + BAR_MM
    return Sheet(f"residuals-{number + 1}", caption, PAGE_MM, height, draw)


def _words(data: ReportData, model: ModelSurface) -> str:
    """Root mean square distances of one organ, by area, as a line; nothing where it is not observed."""
    seen = np.isfinite(model.distance_fitted) & np.isfinite(model.distance_rest)
    area = model.area[seen].astype(np.float64)
    if not area.sum() > 0.0:
        return ""
    spread = [
        text_of(float(np.sqrt(np.average(of[seen].astype(np.float64) ** 2, weights=area))), digits=2)
        for of in (model.distance_rest, model.distance_fitted)
    ]
    return f"{data.tissues[model.tissue].name}: {spread[0]} mm without a fit, {spread[1]} mm fitted"
