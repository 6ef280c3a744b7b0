"""What all figures for papers share: their style, their widths, and how one is written to files."""

from __future__ import annotations

import io
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import matplotlib as mpl
from matplotlib.figure import Figure

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


@dataclass(frozen=True, slots=True)
class Sheet:
    """A figure before it is drawn: its name as a file's, its caption, and its size in mm.

    draw: paints it on an empty figure of that size.
    """

    name: str
    caption: str
    width_mm: float
    height_mm: float
    draw: Callable[[Figure], None]

    def figure(self) -> Figure:
        """The figure; call it under `STYLE`."""
        figure = Figure(figsize=(self.width_mm * MM, self.height_mm * MM))
        self.draw(figure)
        return figure

    def files(self, formats: Sequence[str], *, dpi: int) -> dict[str, bytes]:
        """The figure by the names of its files; dpi: of PNG, and of the pictures inside SVG and PDF."""
        with mpl.rc_context(STYLE):
            figure, found = self.figure(), dict[str, bytes]()
            for kind in formats:
                memory = io.BytesIO()
                figure.savefig(memory, format=kind, dpi=dpi, metadata=METADATA[kind])
                found[f"{self.name}.{kind}"] = memory.getvalue()
        return found
