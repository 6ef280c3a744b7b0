"""Colour scales of a report: distances about zero; moduli, angles and strains from low to high; and their bars."""

from __future__ import annotations

import math
from dataclasses import dataclass

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import LogNorm, Normalize
from matplotlib.ticker import MaxNLocator
from numpy.typing import NDArray

from palpate.body.refusals import LINEAR_RANGE
from palpate.report.report_data import LaterImage, ReportData
from palpate.report.ticks import log_marks, mark_text
from palpate.report.units import shown_unit
from palpate.statement.stiffness_scale import COLOURS, StiffnessScale, stiffness_scale

MOST_TICKS = 6  # of a colour bar whose marks are moduli
UNSEEN = (0.62, 0.63, 0.66)  # where there is no value


@dataclass(frozen=True, slots=True)
class Scale:
    """Colours from `low` to `high` by the map `name` of matplotlib, logarithmic or not; `ticks`: place and label."""

    name: str
    low: float
    high: float
    logarithmic: bool
    label: str
    ticks: tuple[tuple[float, str], ...]

    @property
    def table(self) -> NDArray[np.uint8]:
        """The scale's 256 colours, (256, 3), 0 to 255."""
        shades = mpl.colormaps[self.name](np.linspace(0.0, 1.0, 256))[:, :3]
        return np.rint(255.0 * shades).astype(np.uint8)

    @property
    def gradient(self) -> str:
        """The colours from left to right, as CSS."""
        shades = self.table[np.linspace(0, 255, 17).astype(int)]
        return "linear-gradient(to right, " + ", ".join(f"rgb({r} {g} {b})" for r, g, b in shades.tolist()) + ")"

    def place(self, values: NDArray[np.float64]) -> NDArray[np.float64]:
        """Where values (n,), in the unit of the scale, lie on it, 0 to 1, dimensionless; NaN stays."""
        low, high = (math.log(self.low), math.log(self.high)) if self.logarithmic else (self.low, self.high)
        scaled = np.log(values) if self.logarithmic else values
        return np.clip((scaled - low) / (high - low), 0.0, 1.0)

    def colours(self, values: NDArray[np.float64]) -> NDArray[np.float64]:
        """Colours (n, 3), dimensionless, 0 to 1, of values (n,) in the unit of the scale; grey where there is none."""
        place = self.place(np.asarray(values, dtype=np.float64))
        known = np.isfinite(place)
        shades = self.table[np.rint(255.0 * np.where(known, place, 0.0)).astype(int)] / 255.0
        return np.where(known[:, None], shades, UNSEEN)


def draw_colour_bar(axes: Axes, scale: Scale) -> None:
    """A horizontal bar of a scale's colours, which fills the axes, with its ticks and its label."""
    limits = LogNorm(scale.low, scale.high) if scale.logarithmic else Normalize(scale.low, scale.high)
    colours = ScalarMappable(limits, scale.name)
    bar = axes.figure.colorbar(colours, cax=axes, orientation="horizontal", label=scale.label)
    bar.set_ticks([place for place, _ in scale.ticks], labels=[label for _, label in scale.ticks])
    bar.minorticks_off()
    bar.outline.set_linewidth(0.5)


def distance_scale(voxel_mm: float) -> Scale:
    """Signed distances (mm) from minus to plus two voxels of edge `voxel_mm`, one voxel marked on both sides.

    A scale that reached to the largest motion would show every misfit of a fraction of a voxel as none.
    """
    size = 2.0 * voxel_mm
    ticks = (
        (-size, f"≤ −{size:.3g}"),
        (-voxel_mm, f"−{voxel_mm:.3g} (voxel)"),
        (0.0, "0"),
        (voxel_mm, f"+{voxel_mm:.3g} (voxel)"),
        (size, f"≥ +{size:.3g}"),
    )
    return Scale("coolwarm", -size, size, False, "signed distance (mm)", ticks)


def modulus_scale(data: ReportData) -> Scale:
    """Young's modulus of the meshed tissues, logarithmic, in the unit that is shown; raises `ValueError` for none."""
    of = shown_stiffness(data)
    marks = log_marks(of.low, of.high, most=MOST_TICKS)
    return Scale(COLOURS, of.low, of.high, True, of.label, tuple((mark, mark_text(mark)) for mark in marks))


def shown_stiffness(data: ReportData) -> StiffnessScale:
    """In which unit and between which limits moduli are shown; raises `ValueError` where no tissue has one."""
    unit, moduli = shown_unit(data.document), [tissue.modulus for tissue in data.tissues]
    mapped = np.concatenate([np.zeros(0, np.float32), *(of.moduli for of in data.maps)])
    to, factor = unit.relative_to, unit.of_document(1.0)
    return stiffness_scale(moduli, unit=unit.name, relative_to=to, factor=factor, mapped=mapped)


def shown_moduli(data: ReportData) -> NDArray[np.float64]:
    """Young's modulus (n_tissues,) of each tissue in the unit of `modulus_scale`; NaN where there is none."""
    moduli = np.array([np.nan if tissue.modulus is None else tissue.modulus for tissue in data.tissues])
    return np.asarray(shown_stiffness(data).factor * moduli.astype(np.float64))


def displacement_scale(later: LaterImage) -> Scale:
    """Length of the fitted motion to a later image, from 0 to a round number of mm that nothing exceeds by much."""
    lengths = np.linalg.norm(later.motion.astype(np.float64), axis=1)
    top = float(np.percentile(lengths, 99.9)) if len(lengths) else 0.0
    places = [float(t) for t in MaxNLocator(5, steps=[1, 2, 2.5, 5, 10]).tick_values(0.0, max(top, 1e-3))]
    ticks = tuple((place, f"{place:g}") for place in places)
    return Scale("plasma", 0.0, places[-1], False, "fitted motion (mm)", ticks)


def angle_scale() -> Scale:
    """Smallest dihedral angle of a tetrahedron, degrees; 5 is what the mesh's gate asks for.

    Dark is bad and bright is good, whatever colours one sees.
    """
    ticks = tuple((float(angle), f"{angle}°") for angle in (5, 20, 40, 60))
    return Scale("cividis", 0.0, 70.0, False, "smallest dihedral angle (degrees)", ticks)


def strain_scale() -> Scale:
    """Largest principal strain of a tetrahedron, per cent, with the end of the linear law's range marked."""
    marked = round(100 * LINEAR_RANGE)
    ticks = ((0.0, "0"), (float(marked), f"{marked} % (linear law)"), (20.0, "20 %"), (30.0, "≥ 30 %"))
    return Scale("YlOrRd", 0.0, 30.0, False, "largest principal strain of the fitted state (%)", ticks)
