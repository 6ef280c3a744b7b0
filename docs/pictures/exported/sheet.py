"""What all pictures share: colours, bodies drawn by VTK off the screen, and sheets of titled panels by matplotlib."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib import pyplot as plt
from matplotlib.axes import Axes
from matplotlib.colors import LogNorm, Normalize
from matplotlib.patches import Patch
from numpy.typing import NDArray

COLOURS = {
    "prostate": "#e69f00",
    "bladder": "#56b4e9",
    "rectum": "#cc79a7",
    "bones": "#cfc8b8",
    "surroundings": "#a9adb2",
}
WIDTH, DPI = 12.0, 100  # inches, pixels an inch: text of 15 points has 12 pixels where the picture is 700 wide
LEGEND = {"frameon": False, "handlelength": 1.0, "columnspacing": 1.0, "handletextpad": 0.4, "fontsize": 15}
FROM_THE_SIDE = (1.0, 0.35, 0.25)
Image = NDArray[np.uint8]
Part = tuple[Any, Mapping[str, Any]]  # a data set of PyVista, how `add_mesh` draws it

mpl.use("Agg")
plt.rcParams.update({"font.size": 16, "axes.titlesize": 17, "axes.linewidth": 1.0})


@dataclass(frozen=True)
class Bar:
    """A colour bar: what it shows with its unit, from where to where."""

    title: str
    low: float
    high: float
    colours: str = "viridis"
    logarithmic: bool = False
    ticks: Sequence[float] | None = None

    @property
    def shown(self) -> dict[str, Any]:
        """What `add_mesh` needs to use the same colours; the bar itself is drawn by matplotlib."""
        scale = {"clim": (self.low, self.high), "cmap": self.colours, "log_scale": self.logarithmic}
        return {**scale, "show_scalar_bar": False}


@dataclass(frozen=True)
class Panel:
    """A picture under its title, over a colour bar or the names of its colours."""

    title: str
    image: Image
    bar: Bar | None = None
    names: Mapping[str, str] = field(default_factory=dict)


def drawn(parts: Iterable[Part], bounds: Sequence[float], direction: Sequence[float] = FROM_THE_SIDE) -> Image:
    """Bodies as VTK draws them along a direction, all of `bounds` in sight, without perspective."""
    import pyvista  # takes seconds, and pictures of images do without it

    plotter = pyvista.Plotter(off_screen=True, window_size=[1200, 1000], border=False, lighting="none")
    plotter.add_light(pyvista.Light(light_type="headlight"))  # what faces the eye has the colours of the bars
    plotter.set_background("white")
    for mesh, how in parts:
        plotter.add_mesh(mesh, **{"show_scalar_bar": False, "ambient": 0.4, "diffuse": 0.65, **how})
    plotter.enable_anti_aliasing("ssaa")
    plotter.enable_depth_peeling()
    plotter.view_vector(direction, viewup=(0.0, 0.0, 1.0))
    plotter.enable_parallel_projection()
    plotter.reset_camera(bounds=bounds)
    image = np.asarray(plotter.screenshot(return_img=True))[..., :3]
    plotter.close()
    return image


def trimmed(*images: Image, margin: int = 6) -> list[Image]:
    """Images of one size without the white around what any of them shows, so that their scales stay the same."""
    shown = np.any([np.any(image < 250, axis=2) for image in images], axis=0)
    rows, columns = np.flatnonzero(shown.any(axis=1)), np.flatnonzero(shown.any(axis=0))
    top, left = max(rows[0] - margin, 0), max(columns[0] - margin, 0)
    return [image[top : rows[-1] + margin, left : columns[-1] + margin] for image in images]


def write_sheet(picture: Path, panels: Sequence[Panel]) -> None:
    """Panels side by side, of one height, with their titles, bars and names."""
    gap, title = 0.25, 0.45
    shapes = [panel.image.shape[1] / panel.image.shape[0] for panel in panels]
    height = (WIDTH - gap * (len(panels) + 1)) / sum(shapes)
    columns = [_columns(panel.names, shape * height) for panel, shape in zip(panels, shapes, strict=True)]
    rows = max(math.ceil(len(panel.names) / n) for panel, n in zip(panels, columns, strict=True))
    foot = max(0.9, 0.33 * rows + 0.05)
    whole = height + title + foot
    figure = plt.figure(figsize=(WIDTH, whole), dpi=DPI)
    left = gap
    for panel, shape, n_columns in zip(panels, shapes, columns, strict=True):
        width = shape * height
        place = (left / WIDTH, foot / whole, width / WIDTH, height / whole)
        axes = figure.add_axes(place)
        axes.imshow(panel.image, interpolation="antialiased")
        axes.set_axis_off()
        axes.set_title(panel.title, pad=10)
        if panel.bar is not None:
            inside = (left + 0.1 * width, 0.8 * width, foot - 0.28, 0.2)
            add_bar(figure, panel.bar, (inside[0] / WIDTH, inside[2] / whole, inside[1] / WIDTH, inside[3] / whole))
        if panel.names:
            handles = [Patch(color=colour, label=name) for name, colour in panel.names.items()]
            figure.legend(
                handles=handles,
                loc="center",
                bbox_to_anchor=((left + 0.5 * width) / WIDTH, 0.5 * foot / whole),
                ncols=n_columns,
                **LEGEND,
            )
        left += width + gap
    saved(figure, picture)


def _columns(names: Mapping[str, str], width: float) -> int:
    """As many columns of names as fit into a width in inches."""
    column = 0.5 + 0.11 * max(map(len, names), default=0)
    return max(1, min(len(names), int(width / column)))


def add_bar(figure: Any, bar: Bar, place: tuple[float, float, float, float]) -> None:
    """A horizontal colour bar at a place of the figure, its title under it."""
    norm = LogNorm(bar.low, bar.high) if bar.logarithmic else Normalize(bar.low, bar.high)
    axes: Axes = figure.add_axes(place)
    drawn_bar = figure.colorbar(mpl.cm.ScalarMappable(norm, bar.colours), cax=axes, orientation="horizontal")
    if bar.ticks is not None:
        drawn_bar.set_ticks(list(bar.ticks), labels=[f"{tick:g}" for tick in bar.ticks])
    drawn_bar.ax.minorticks_off()
    drawn_bar.ax.tick_params(labelsize=15, pad=2)
    drawn_bar.set_label(bar.title, labelpad=2)


def saved(figure: Any, picture: Path) -> None:
    """Write a figure as JPEG or PNG, by the picture's name."""
    quality = {"pil_kwargs": {"quality": 74, "optimize": True}} if picture.suffix == ".jpg" else {}
    figure.savefig(picture, dpi=DPI, facecolor="white", **quality)
    plt.close(figure)
