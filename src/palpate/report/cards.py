"""The estimates of a result alone: as lines, as cards for a notebook, as a figure with their intervals."""

from __future__ import annotations

import io
from collections.abc import Mapping
from typing import Any

import matplotlib as mpl
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from palpate.report.figures.moduli import chosen_unit, draw_moduli
from palpate.report.rows import NONE, estimate_rows, moduli_in, ratio_rows
from palpate.report.svg import page_of

NOTEBOOK_DPI = 110
STYLE = {"text.parse_math": False, "font.family": "DejaVu Sans"}  # a tissue called $x is a name, not a formula


def result_lines(document: Mapping[str, Any]) -> str:
    """A line a tissue of the document result.json: value with its 95 % interval, verdict and why."""
    lines = [] if document["status"] == "converged" else [f"{document['status']}: {document['reason']}"]
    for row in estimate_rows(document, {}):
        found = "no value"
        if row.value != NONE and row.verdict == "ratio only":  # whose scale is known within a range
            found = f"{row.ratio} x {row.relative_to} (95 %: {row.ratio_interval}), {row.value} kPa if it has"
            found += f" {row.reference} kPa"
        elif row.value != NONE:
            found = f"{row.value} kPa" + (f" (95 %: {row.interval} kPa)" if row.interval != NONE else "")
        elif row.ratio != NONE:
            found = f"{row.ratio} x {row.relative_to}"
            found += f" (95 %: {row.ratio_interval})" if row.ratio_interval != NONE else ""
        lines.append(f"{row.tissue}: {found}, {row.verdict}: {row.why}")
    return "\n".join(lines)


def result_cards(document: Mapping[str, Any], colours: Mapping[str, str]) -> str:
    """HTML with a card a tissue: value, interval, verdict and why, escaped; then the warnings.

    document: result.json; colours: tissue -> #rrggbb.
    """
    rows, ratios = estimate_rows(document, colours), ratio_rows(document)
    return page_of("cards.html", document=document, rows=rows, ratios=ratios)


class ShownFigure(Figure):
    """A figure that a notebook shows at the end of a cell, also where pyplot is not used; no window is opened."""

    def _repr_png_(self) -> bytes:
        """The picture that a notebook shows."""
        memory = io.BytesIO()
        with mpl.rc_context(STYLE):
            self.savefig(memory, format="png", dpi=NOTEBOOK_DPI)
        return memory.getvalue()


def moduli_figure(document: Mapping[str, Any], colours: Mapping[str, str], unit: str | None = None) -> ShownFigure:
    """A figure of the moduli with their 95 % intervals; open ends are arrows, truths dashes.

    document, colours: as above; unit: "kPa", "ratio", or None for that of the report. What did not converge is named
    without a number. Raises `ConfigurationError` for a unit in which there are no numbers.
    """
    of = chosen_unit(document, unit)
    with mpl.rc_context(STYLE):
        figure = ShownFigure(figsize=(6.4, 1.2 + 0.6 * max(len(moduli_in(document)), 1)), layout="constrained")
        draw_moduli(figure.add_subplot(), document, colours, of)
    return figure


def moduli_axes(axes: Axes, document: Mapping[str, Any], colours: Mapping[str, str], unit: str | None = None) -> Axes:
    """The same drawn on axes, which are given back; raises as above."""
    of = chosen_unit(document, unit)
    with mpl.rc_context(STYLE):
        draw_moduli(axes, document, colours, of)
    return axes
