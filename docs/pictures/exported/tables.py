"""The picture of samples: what xarray finds in posterior.nc."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import xarray
from matplotlib import pyplot as plt

from .sheet import COLOURS, WIDTH, saved


def tables(folder: Path, picture: Path) -> None:
    """A histogram of all draws for each tissue, and the interval of the result from `constant_data`."""
    path = folder / "posterior.nc"
    samples = xarray.open_dataset(path, group="posterior", engine="h5netcdf").youngs_modulus
    constant = xarray.open_dataset(path, group="constant_data", engine="h5netcdf")
    figure, axes = plt.subplots(figsize=(WIDTH, 5.2))
    figure.subplots_adjust(left=0.02, right=0.98, top=0.97, bottom=0.17)
    bins = np.geomspace(0.88 * float(samples.min()), 1.05 * float(samples.max()), 90)
    draws = {str(name): samples.sel(tissue=name).values.ravel() for name in samples.tissue.values}
    tallest = max(np.histogram(values, bins)[0].max() for values in draws.values())
    for name, values in draws.items():
        counts, *_ = axes.hist(values, bins, color=COLOURS[name], edgecolor="white", linewidth=0.5)
        low, high = (float(constant[f"interval95_{end}"].sel(tissue=name)) for end in ("low", "high"))
        axes.plot([low, high], [-0.06 * tallest] * 2, color="black", linewidth=6, solid_capstyle="butt")
        middle = float(np.median(values))
        words = f"{name}: median of the draws {middle:.1f} {samples.units}\n95 % interval {low:.1f} to {high:.1f}"
        axes.text(middle, counts.max() + 0.05 * tallest, words, ha="center", va="bottom")
    axes.set_ylim(-0.12 * tallest, 1.25 * tallest)
    axes.set_xscale("log")
    ticks = [tick for tick in (5, 10, 15, 20, 30, 40, 50, 70, 100) if bins[0] <= tick <= bins[-1]]
    axes.set_xticks(ticks, [f"{tick}" for tick in ticks])
    axes.minorticks_off()
    axes.set_yticks([])
    axes.spines[["left", "right", "top"]].set_visible(False)
    axes.set_xlabel(f"Young's modulus ({samples.units})")
    saved(figure, picture)
