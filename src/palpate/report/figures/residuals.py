"""The organs' surfaces coloured by their distance to the later image, before and after the model was fitted."""

from __future__ import annotations

import io

import matplotlib.image as mpimg
from matplotlib.figure import Figure

from palpate.report.charts import spread_words
from palpate.report.figures.sheet import PAGE_MM, size_mm
from palpate.report.figures.slices import colour_bar
from palpate.report.pictures import organs_png
from palpate.report.report_data import LaterImage, ReportData
from palpate.report.scales import distance_scale

HEIGHT_MM, BAR_MM, WORDS_MM, TITLE_MM = 58.0, 15.0, 3.6, 6.0
PIXELS = (1000, 690)  # of each picture


def residual_sheet(figure: Figure, data: ReportData, later: LaterImage) -> str:
    """The pair of pictures for a later image, what they come to in numbers, and their caption.

    Raises `ValueError` where there is no fitted model.
    """
    told = [(data.tissues[model.tissue].name, spread_words(model)) for model in later.model]
    words = [f"{name}: {spread}" for name, spread in told if spread]
    bottom = BAR_MM + WORDS_MM * len(words) + 2.0
    tall = bottom + HEIGHT_MM + TITLE_MM
    size_mm(figure, PAGE_MM, tall)
    for fitted, title in enumerate((f"without a fit, to {later.name}", f"fitted to {later.name}")):
        axes = figure.add_axes((0.5 * fitted, bottom / tall, 0.5, HEIGHT_MM / tall))
        axes.imshow(mpimg.imread(io.BytesIO(organs_png(data, later, fitted=bool(fitted), size=PIXELS))))
        axes.set_axis_off()
        axes.set_title(title, loc="left", x=0.02, pad=2.0)
    for row, line in enumerate(words):
        figure.text(0.5, (bottom - 1.0 - WORDS_MM * (row + 0.5)) / tall, line, ha="center", va="center")
    colour_bar(figure, distance_scale(data.references[later.reference].voxel_mm))
    return (
        f"Surfaces of the model, coloured by their signed distance to {later.name} in mm. Left: as they lie in the"
        " earlier image. Right: as fitted. Red parts stand out of the organ in the later image, blue parts stay inside"
        " it. Grey parts are not observed. The marks at one voxel show the length of its edge. The numbers are root"
        " mean squares over the observed surface."
    )
