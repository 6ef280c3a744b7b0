"""Closed surfaces of organs as a label image: for who has surfaces, and no image that they were drawn on."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import igl
import numpy as np
from numpy.typing import NDArray

from palpate.errors import ConfigurationError, InputDataError, ResourceError
from palpate.findings import Finding, warning_rows
from palpate.images import LabelImage, VoxelGrid
from palpate.images.label_image import LPS_TO_RAS
from palpate.images.named_labels import NamedLabel
from palpate.images.readers.merged_masks import Mask, merged
from palpate.images.readers.stl import SurfaceFile, read_stl
from palpate.progress import Line, Progress, silent

MOST_VOXELS = 2**28
MOST_SURFACES = 500
AT_ONCE = 2**20  # voxels of a surface that are asked together
HALF = 0.5  # a turn: nearer to one than to none
LIKELY_MM3 = (100.0, 2e8)  # of what is segmented: a seed, a whole body
DOUBTFUL = 0.2  # of the volume, more than voxels cost


@dataclass(frozen=True, slots=True)
class SurfaceLabels:
    """A label image with the organs' names; volumes_mm3: of each organ by its surface, and by its voxels."""

    image: LabelImage
    volumes_mm3: dict[str, tuple[float, float]]

    def to_dict(self) -> dict[str, Any]:
        """What it prints as JSON."""
        grid = self.image.grid
        return {
            "shape": list(grid.shape),
            "spacing_mm": grid.spacing.tolist(),
            "labels": {str(label): name for label, name in self.image.names.items()},
            "volumes_mm3": {name: {"surface": a, "voxels": b} for name, (a, b) in self.volumes_mm3.items()},
            "warnings": warning_rows(self.image.findings),
        }


def surface_labels(
    files: Sequence[Path],
    *,
    spacing_mm: float = 1.0,
    margin_mm: float = 30.0,
    axes: str | None = None,
    scale: float = 1.0,
    like: VoxelGrid | None = None,
    progress: Progress = silent,
) -> SurfaceLabels:
    """The label image of closed surfaces (STL), one an organ, which is called as its file is.

    A voxel is an organ's where the surface winds once round its centre: where its generalised winding number is nearer
    to 1, or -1, than to 0 (Jacobson, Kavan & Sorkine-Hornung, ACM Trans. Graph. 32 (2013) 33; libigl). One that several
    organs claim goes to the smallest of them. The grid reaches `margin_mm` beyond all surfaces, in voxels of
    `spacing_mm`, or is the one that is given (`like`: that of the first state's image). axes: "RAS" or "LPS", of files
    that do not say (None: RAS); scale: of the coordinates, 1000 for files in metres. Raises `InputDataError` as
    `read_stl`, for an organ without a voxel, and where files say their axes and others do not,
    `ConfigurationError` for names that stand twice or too many, `ResourceError` for a grid that is too large.
    """
    names = {file.stem: number for number, file in enumerate(files, start=1)}
    if len(names) < len(files) or not 0 < len(files) <= MOST_SURFACES:
        flaw = f"{len(files)} surfaces are given, with {len(names)} different names"
        raise ConfigurationError(f"{flaw}; give 1 to {MOST_SURFACES} files with different names, one for each organ")
    surfaces = {file.stem: read_stl(file) for file in files}
    said = {surface.space: file for file, surface in zip(files, surfaces.values(), strict=True)}
    if axes is None and "" in said and len(said) > 1:
        space = max(said)
        advice = f"write --axes {space} where one program wrote both, else --axes {'LPS' if space == 'RAS' else 'RAS'}"
        flaw = f"the heading of '{said[space]}' says SPACE={space}, that of '{said['']}' does not say its axes"
        raise InputDataError(f"{flaw}; {advice}")
    signs = {"": LPS_TO_RAS if axes == "LPS" else 1.0, "RAS": 1.0, "LPS": LPS_TO_RAS}
    surfaces = {name: replace(of, points=of.points * signs[of.space] * scale) for name, of in surfaces.items()}
    grid = like
    if grid is None:  # cubes along RAS that hold all surfaces and the margin
        low, high = (np.array([of.ends[side] for of in surfaces.values()]) for side in (0, 1))
        low, high = low.min(axis=0) - margin_mm, high.max(axis=0) + margin_mm
        nx, ny, nz = (int(n) for n in np.ceil((high - low) / spacing_mm))
        affine = np.diag([spacing_mm, spacing_mm, spacing_mm, 1.0])
        affine[:3, 3] = low + 0.5 * spacing_mm
        grid = VoxelGrid((nx, ny, nz), affine)
    if (size := math.prod(grid.shape)) > MOST_VOXELS:
        flaw = f"the grid would have {size:.3g} voxels, over {MOST_VOXELS}; use larger voxels, or a smaller margin"
        raise ResourceError(flaw + next(filter(None, map(_other_unit, surfaces.values())), ""))
    volumes, findings = dict[str, tuple[float, float]](), list[Finding]()

    def masks() -> Iterator[Mask]:
        for name, surface in surfaces.items():
            progress(Line(f"surface {names[name]} of {len(surfaces)}: {name}"))
            inside = _inside(surface, grid)
            count = int(np.count_nonzero(inside))
            volumes[name] = (surface.held_mm3, count * grid.voxel_volume)
            findings.extend(_flaws(name, surface, count, grid))
            yield Mask(NamedLabel(names[name], name), inside)

    labels, overlaps = merged(masks(), grid.shape)
    left = np.bincount(labels.ravel(), minlength=len(names) + 1)
    for name, number in names.items():
        if not left[number]:
            count = round(volumes[name][1] / grid.voxel_volume)
            raise InputDataError(
                f"smaller organs claim all {count} voxels of '{name}'; check whether a surface is given twice"
            )
    called = {number: name for name, number in names.items()}
    digests = {name: surface.digest for name, surface in surfaces.items()}
    return SurfaceLabels(LabelImage(labels, grid, called, {}, digests, (*findings, *overlaps)), volumes)


def _flaws(name: str, surface: SurfaceFile, count: int, grid: VoxelGrid) -> list[Finding]:
    """Findings by the number of a surface's voxels, `count`; raises `InputDataError` where there is none."""
    held, counted = surface.held_mm3, count * grid.voxel_volume
    volume, last = f"{held / 1000.0:.3g} mL", np.array(grid.shape) - 1.0
    if not count or np.ptp(surface.ends, axis=0).max() < 2.0 * grid.spacing.max():
        low, high, first, end = (np.round(each, 3).tolist() for each in (*surface.ends, *grid.world(last * [[0], [1]])))
        raise InputDataError(
            f"'{name}' has {count} voxels: it holds {volume} from {low} to {high} mm (RAS), on a grid from {first} to"
            f" {end} mm in voxels of {grid.spacing.max():.3g}"
            f" mm{_other_unit(surface) or '; check its unit and its axes (--scale, --axes)'}"
        )
    found = []
    index = grid.index(surface.points)
    if counted < held and (np.abs(index - 0.5 * last) > 0.5 * last + 0.5).any():
        text = (
            f"{1.0 - counted / held:.1%} of '{name}' ({volume}) lies outside the grid. Use a larger image as the grid."
        )
        found.append(Finding("cut-by-border", text, name))
    elif abs(counted - held) > DOUBTFUL * held:
        text = (
            f"The triangles of '{name}' enclose {volume}, but its voxels {counted / 1000.0:.3g} mL: pieces overlap,"
            " occur twice, or are inside out. Join them to one surface in the program that made it."
        )
        found.append(Finding("overlap", text, name))
    pieces = int(igl.facet_components(surface.triangles)[0])
    if pieces > 1:
        text = (
            f"'{name}' has {pieces} closed pieces, which were taken as one tissue. Give each tissue a file of its own."
        )
        found.append(Finding("islands", text, name))
    return found


def _other_unit(surface: SurfaceFile) -> str:
    """What is to be written where the surface holds as much as organs do in another unit, as the end of a sentence."""
    for factor, unit in ((1000.0, "metres"), (10.0, "centimetres"), (0.001, "micrometres")):
        volume = surface.held_mm3 * factor**3
        if not LIKELY_MM3[0] < surface.held_mm3 < LIKELY_MM3[1] and LIKELY_MM3[0] < volume < LIKELY_MM3[1]:
            times = f"{factor:g} times as large it would be {volume / 1000.0:.3g} mL"
            return f"; {times}: where the file is in {unit}, write --scale {factor:g}"
    return ""


def _inside(surface: SurfaceFile, grid: VoxelGrid) -> NDArray[np.bool_]:
    """Which voxels (nx, ny, nz) of a grid have their centres inside; those away from the surface are not asked."""
    places = grid.index(surface.points)
    low = np.clip(np.floor(places.min(axis=0)), 0, grid.shape).astype(int)
    high = np.clip(np.ceil(places.max(axis=0)) + 1, 0, grid.shape).astype(int)
    found = np.zeros(grid.shape, dtype=bool)
    if (high <= low).any():
        return found
    slab = max(AT_ONCE // int(np.prod((high - low)[1:])), 1)
    for first in range(low[0], high[0], slab):
        part = np.s_[first : min(first + slab, high[0]), low[1] : high[1], low[2] : high[2]]
        index = np.moveaxis(np.mgrid[part], 0, -1)
        centres = np.ascontiguousarray(grid.world(index.reshape(-1, 3).astype(np.float64)))
        winding = np.asarray(igl.fast_winding_number(surface.points, surface.triangles, centres))
        found[part] = (np.abs(winding) > HALF).reshape(index.shape[:3])
    return found
