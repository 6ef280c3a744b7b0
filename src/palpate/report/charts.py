"""Charts of a report: convergence of every start, angles of the mesh."""

from __future__ import annotations

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, LogLocator, MaxNLocator, NullFormatter

from palpate.inversion.estimation import Estimation, ModulusEstimate
from palpate.mesh.dihedral import tet_dihedrals
from palpate.mesh.tet_mesh import TetMesh
from palpate.report.colours import START_COLOURS
from palpate.report.svg import INK, draw_svg

__all__ = ["angle_svg", "modulus_svg", "objective_svg"]

SIZE = (3.9, 2.5)


def objective_svg(estimation: Estimation, *, name: str) -> str:
    """Misfit (mm^2) of every start against the iteration, as SVG."""
    paths = [[step.objective_mm2 for step in start.history] for start in estimation.starts]
    return draw_svg(lambda figure: _paths(figure, paths, "misfit (mm²)"), size=SIZE, name=name)


def modulus_svg(estimation: Estimation, estimate: ModulusEstimate, *, name: str) -> str:
    """Modulus of one tissue in every start against the iteration, with the estimate's interval, as SVG."""
    tissue = estimate.tissue
    paths = [[step.moduli.get(tissue, np.nan) for step in start.history] for start in estimation.starts]
    unit = "kPa" if estimate.unit == "kPa" else "ratio"

    def draw(figure: Figure) -> None:
        _paths(figure, paths, f"{tissue} ({unit})")
        interval = estimate.interval95 if estimate.unit == "kPa" else estimate.ratio_interval95
        if interval is not None and interval[0] is not None and interval[1] is not None:
            figure.axes[0].axhspan(interval[0], interval[1], color=INK, alpha=0.1, linewidth=0)
        if estimate.truth is not None:
            figure.axes[0].axhline(estimate.truth, color=INK, linewidth=1.0, linestyle=(0, (4, 3)))

    return draw_svg(draw, size=SIZE, name=name)


def angle_svg(mesh: TetMesh, *, name: str) -> str:
    """Histogram of the mesh's dihedral angles (degrees) as SVG."""
    angles = tet_dihedrals(mesh.nodes[mesh.tets]).ravel()

    def draw(figure: Figure) -> None:
        axes = figure.add_axes((0.15, 0.2, 0.82, 0.7))
        share = np.full(len(angles), 100.0 / len(angles))
        axes.hist(angles, bins=list(range(0, 181, 5)), weights=share, color=START_COLOURS[0], alpha=0.85)
        axes.axvline(5.0, color=INK, linewidth=1.0, linestyle=(0, (4, 3)))
        axes.set_xlim(0, 180)
        axes.set_xticks(range(0, 181, 30))
        axes.set_xlabel("dihedral angle (degrees)")
        axes.set_ylabel("share (%)")
        axes.yaxis.set_major_locator(MaxNLocator(4))

    return draw_svg(draw, size=SIZE, name=name)


def _paths(figure: Figure, paths: list[list[float]], label: str) -> None:
    """One line a start on a logarithmic axis."""
    axes = figure.add_axes((0.17, 0.2, 0.8, 0.74))
    for number, path in enumerate(paths):
        colour = START_COLOURS[number % len(START_COLOURS)]
        axes.plot(range(len(path)), path, color=colour, linewidth=1.6, marker="o", markersize=3.2)
    axes.set_xlabel("iteration")
    axes.set_ylabel(label[:40])
    axes.xaxis.set_major_locator(MaxNLocator(6, integer=True))
    values = np.array([value for path in paths for value in path])
    if len(values) and (values > 0).all():
        axes.set_yscale("log")
        axes.yaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
        axes.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:.3g}"))
        axes.yaxis.set_minor_formatter(NullFormatter())
    axes.grid(visible=True, axis="y")
