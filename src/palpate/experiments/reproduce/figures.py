"""The experiments' figures, as SVG files."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import matplotlib as mpl
import numpy as np
from matplotlib.figure import Figure

from palpate.experiments.reproduce.balls import BODIES
from palpate.experiments.reproduce.figure4 import LAW, LEAVE_PERCENT, Figure4
from palpate.experiments.reproduce.staging import Staging
from palpate.experiments.reproduce.table import COLUMNS, Table
from palpate.study import staged

__all__ = ["draw_figure4", "draw_staging", "draw_table"]

STYLE = {
    "svg.fonttype": "none",
    "font.family": "sans-serif",
    "svg.hashsalt": "palpate",
    "font.size": 9.0,
    "axes.grid": True,
    "grid.alpha": 0.3,
}
COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9")  # Okabe & Ito 2008: safe for colour-blind
MARKERS = ("o", "s", "^", "D", "v")
SMALLEST = 1e-6  # per cent: what is smaller is drawn there
LINESTYLES = {"linear": "-", LAW: "--"}


def draw_table(table: Table, path: Path) -> None:
    """Absolute errors of every column and of the paper, a panel a body, into `path` (SVG); `ResourceError`."""
    bodies = list(dict.fromkeys(row.body for row in table.rows))

    def draw(figure: Figure) -> None:
        """All panels."""
        panels = figure.subplots(1, len(bodies), sharey=True, squeeze=False)[0]
        for axes, body in zip(panels, bodies, strict=True):
            rows = [row for row in table.rows if row.body == body]
            places = np.arange(len(rows))
            papers = [
                (i, abs(100.0 * (r.paper_kpa / r.true_kpa - 1.0)))
                for i, r in enumerate(rows)
                if r.paper_kpa is not None
            ]
            if papers:
                axes.plot(*zip(*papers, strict=True), linestyle="none", marker="x", color="black", label="the paper")
            for name, colour, marker in zip(COLUMNS, COLOURS, MARKERS, strict=False):
                errors = [row.columns[name].error_percent for row in rows]
                sizes = [np.nan if error is None else max(abs(error), SMALLEST) for error in errors]
                axes.plot(places, sizes, linestyle="none", marker=marker, color=colour, markersize=4.5, label=name)
            axes.set_yscale("log")
            axes.minorticks_off()
            axes.set_xticks(places, [row.case for row in rows], rotation=60, ha="right", fontsize=7.5)
            axes.set_xlabel("true modulus, kPa")
            axes.set_title(body)
        panels[0].set_ylabel("absolute error of the modulus, %")
        figure.legend(*panels[0].get_legend_handles_labels(), loc="outside lower center", ncols=3, frameon=False)

    _save(draw, path, width=3.2 * len(bodies) + 0.8)


def draw_figure4(result: Figure4, path: Path) -> None:
    """Error against deformation, a panel a sphere, a line a modulus and law, into `path` (SVG); `ResourceError`."""

    def draw(figure: Figure) -> None:
        """All panels."""
        panels = figure.subplots(1, len(BODIES), sharey=True)
        for axes, body in zip(panels, BODIES, strict=True):
            cases = list(dict.fromkeys(point.case for point in result.points))
            for law, style in LINESTYLES.items():
                lines = result.lines(law)
                for colour, case in zip(COLOURS, cases, strict=False):
                    points = lines.get((body, case), [])
                    errors = [np.nan if p.error_percent is None else p.error_percent for p in points]
                    deformations = [p.deformation_percent for p in points]
                    axes.plot(deformations, errors, style, color=colour, marker=".", label=f"{case} kPa, {law}")
            axes.axhspan(-LEAVE_PERCENT, LEAVE_PERCENT, color="0.9", zorder=0)
            axes.set_title(body)
            axes.set_xlabel("deformation, %")
        panels[0].set_ylabel("error of the modulus, %")
        figure.legend(*panels[0].get_legend_handles_labels(), loc="outside lower center", ncols=3, frameon=False)

    _save(draw, path, width=10.0)


def draw_staging(result: Staging, path: Path) -> None:
    """Box plots of the estimates by stage, a panel an organ (the paper's figures 7 and 8), into `path` (SVG)."""

    def draw(figure: Figure) -> None:
        """All panels."""
        panels = figure.subplots(1, len(result.organs))
        for axes, organ in zip(panels, result.organs, strict=True):
            stages = sorted({patient.stage for patient in result.patients})
            values = [[kpa for p in result.patients if p.stage == stage for kpa in p.kpa[organ]] for stage in stages]
            axes.boxplot(values, positions=stages, widths=0.5, showfliers=False)
            for number, patient in enumerate(result.patients):
                place = patient.stage + 0.04 * (number - 0.5 * (len(result.patients) - 1))
                median = float(np.median(patient.kpa[organ]))
                axes.plot(
                    place, median, "o", color=COLOURS[0], markersize=4.0, label="" if number else "patient, median"
                )
                axes.plot(
                    place, patient.true_kpa[organ], "_", color=COLOURS[1], label="" if number else "patient, truth"
                )
            axes.set_xticks(stages, [f"T{stage}" for stage in stages])
            axes.legend(fontsize=7.5, frameon=False)
            axes.set_title(f"{organ} (simulated)")
            axes.set_xlabel("T stage")
            axes.set_ylabel("Young's modulus, kPa")

    _save(draw, path, width=8.5)


def _save(draw: Callable[[Figure], None], path: Path, *, width: float) -> None:
    with mpl.rc_context(STYLE):
        figure = Figure(figsize=(width, 4.0), layout="constrained")
        draw(figure)
        with staged(path.parent) as staging:
            figure.savefig(staging.area / path.name, format="svg", metadata={"Date": None})
            staging.commit()
