"""A map of stiffness inside a tissue: slices of the modulus, and of how far it may be off."""

from __future__ import annotations

from palpate.report.figures.sheet import Sheet
from palpate.report.report_data import ReportData
from palpate.report.scales import shown_stiffness
from palpate.report.stiffness_maps import map_drawing

WIDTH_MM, HEIGHT_MM = 112.0, 176.0


def map_sheet(data: ReportData, number: int) -> Sheet:
    """The map of that number."""
    of = data.maps[number]
    caption = (
        f"Map of stiffness inside {data.tissues[of.tissue].name}, in three slices. Left:"
        f" {shown_stiffness(data).label}. Right: the factor by which it may be off (one standard deviation of its"
        " logarithm). Both bars are logarithmic. Hatched: the data removed less than half of what was not known; there"
        f" the mean of the tissue is shown. {of.words}"
    )
    return Sheet(f"map-{number + 1}", caption, WIDTH_MM, HEIGHT_MM, map_drawing(data, of))
