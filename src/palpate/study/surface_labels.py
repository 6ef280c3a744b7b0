"""Closed surfaces of organs as a label image: for who has surfaces, and no image that they were drawn on."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import igl
import numpy as np
from numpy.typing import NDArray

from palpate.errors import ConfigurationError, ResourceError
from palpate.findings import warning_rows
from palpate.images import LabelImage, VoxelGrid
from palpate.images.named_labels import NamedLabel
from palpate.images.readers.merged_masks import Mask, merged
from palpate.images.readers.stl import SurfaceFile, read_stl
from palpate.progress import Progress, silent

MOST_VOXELS = 2**28
MOST_SURFACES = 500
AT_ONCE = 2**20  # voxels of a surface that are asked together
HALF = 0.5  # a turn: nearer to one than to none


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
    axes: str = "RAS",
    like: VoxelGrid | None = None,
    progress: Progress = silent,
) -> SurfaceLabels:
    """The label image of closed surfaces (STL), one an organ, which is called as its file is.

    A voxel is an organ's where the surface winds once round its centre: where its generalised winding number is nearer
    to 1, or -1, than to 0 (Jacobson, Kavan & Sorkine-Hornung, ACM Trans. Graph. 32 (2013) 33; libigl). One that several
    organs claim goes to the smallest of them. The grid reaches `margin_mm` beyond all surfaces, in voxels of
    `spacing_mm`, or is the one that is given (`like`: that of the first state's image). axes: of files that do not say.
    Raises `InputDataError` as `read_stl`, `ConfigurationError` for names that stand twice or too many,
    `ResourceError` for a grid that is too large.
    """
    names = [file.stem for file in files]
    if len(set(names)) < len(names) or not 0 < len(files) <= MOST_SURFACES:
        raise ConfigurationError(
            f"{len(files)} surfaces are named, of {len(set(names))} names; give 1 to {MOST_SURFACES} files of different"
            " names, which are those of the organs"
        )
    surfaces = [read_stl(file, axes=axes) for file in files]
    grid = like
    if grid is None:  # cubes along RAS that hold all surfaces and the margin
        low = np.min([surface.points.min(axis=0) for surface in surfaces], axis=0) - margin_mm
        high = np.max([surface.points.max(axis=0) for surface in surfaces], axis=0) + margin_mm
        shape = np.ceil((high - low) / spacing_mm)
        affine = np.diag([spacing_mm, spacing_mm, spacing_mm, 1.0])
        affine[:3, 3] = low + 0.5 * spacing_mm
        grid = VoxelGrid((int(shape[0]), int(shape[1]), int(shape[2])), affine)
    if (size := float(np.prod([float(n) for n in grid.shape]))) > MOST_VOXELS:
        raise ResourceError(
            f"the grid would have {size:.3g} voxels, over {MOST_VOXELS}; take larger ones, or less margin"
        )
    insides = dict[str, int]()

    def masks() -> Iterator[Mask]:
        for number, (name, surface) in enumerate(zip(names, surfaces, strict=True), start=1):
            progress(f"surface {number} of {len(surfaces)}: {name}")
            inside = _inside(surface, grid)
            insides[name] = int(np.count_nonzero(inside))
            yield Mask(NamedLabel(number, name), inside)

    labels, findings = merged(masks(), grid.shape)
    digests = {name: surface.digest for name, surface in zip(names, surfaces, strict=True)}
    image = LabelImage(labels, grid, dict(enumerate(names, start=1)), {}, digests, findings)
    volumes = dict[str, tuple[float, float]]()
    for name, surface in zip(names, surfaces, strict=True):
        a, b, c = np.moveaxis(surface.points[surface.triangles], 1, 0)
        held = float(abs(np.einsum("ni,ni->n", a, np.cross(b, c)).sum()) / 6.0)
        volumes[name] = (held, insides[name] * grid.voxel_volume)
    return SurfaceLabels(image, volumes)


def _inside(surface: SurfaceFile, grid: VoxelGrid) -> NDArray[np.bool_]:
    """Which voxels (nx, ny, nz) of a grid have their centres inside; those away from the surface are not asked."""
    places = grid.index(surface.points)
    low = np.clip(np.floor(places.min(axis=0)), 0, grid.shape).astype(int)
    high = np.clip(np.ceil(places.max(axis=0)) + 1, 0, grid.shape).astype(int)
    found = np.zeros(grid.shape, dtype=bool)
    if (high <= low).any():
        return found
    triangles = np.ascontiguousarray(surface.triangles)
    points = np.ascontiguousarray(surface.points)
    slab = max(AT_ONCE // int(np.prod((high - low)[1:])), 1)
    for first in range(low[0], high[0], slab):
        ranges = [range(first, min(first + slab, high[0])), *map(range, low[1:].tolist(), high[1:].tolist())]
        index = np.stack(np.meshgrid(*ranges, indexing="ij"), axis=-1)
        centres = np.ascontiguousarray(grid.world(index.reshape(-1, 3).astype(np.float64)))
        winding = np.asarray(igl.fast_winding_number(points, triangles, centres))
        part = tuple(slice(each.start, each.stop) for each in ranges)
        found[part] = (np.abs(winding) > HALF).reshape(index.shape[:3])
    return found
