"""What all figures for papers share: their style, their widths, and how one is written to files."""

from __future__ import annotations

import io
from collections.abc import Sequence

import matplotlib as mpl
from matplotlib.figure import Figure

from palpate.report.svg import Chart

COLUMN_MM, PAGE_MM = 85.0, 170.0  # one and two columns of most journals
MM = 1.0 / 25.4  # inches
FORMATS = ("svg", "pdf", "png")
STYLE = {
    "svg.fonttype": "none",  # text stays text that can be searched and changed
    "pdf.fonttype": 42,  # fonts are embedded whole, as outlines of TrueType
    "svg.hashsalt": "palpate",
    "text.parse_math": False,  # a tissue called $x is a name, not a formula
    "font.family": "sans-serif",
    "font.sans-serif": ["DejaVu Sans", "Arial", "Helvetica"],
    "font.size": 7.0,
    "axes.titlesize": 7.5,
    "axes.labelsize": 7.0,
    "xtick.labelsize": 7.0,
    "ytick.labelsize": 7.0,
    "axes.linewidth": 0.6,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "figure.facecolor": "white",
    "savefig.facecolor": "white",
    "savefig.bbox": None,
}
METADATA = {
    "svg": {"Date": None, "Creator": "Palpate"},
    "pdf": {"CreationDate": None, "Creator": "Palpate", "Producer": None},
    "png": {"Software": "Palpate"},
}


def size_mm(figure: Figure, width: float, height: float) -> None:
    """Give a figure its width and height in mm."""
    figure.set_size_inches(width * MM, height * MM)


def figure_files(name: str, chart: Chart, formats: Sequence[str], *, dpi: int) -> tuple[dict[str, bytes], str]:
    """A figure by the names of its files, and its caption, which are the words of its chart.

    dpi: of PNG, and of the pictures inside SVG and PDF.
    """
    with mpl.rc_context(STYLE):
        figure, found = Figure(), dict[str, bytes]()
        caption = chart(figure)
        for kind in formats:
            memory = io.BytesIO()
            figure.savefig(memory, format=kind, dpi=dpi, metadata=METADATA[kind])
            found[f"{name}.{kind}"] = memory.getvalue()
    return found, caption
