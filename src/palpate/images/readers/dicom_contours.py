"""RTSTRUCT: planar contours made a label image on the grid of the series that they were drawn on.

A voxel belongs to a structure when its centre is inside an odd number of the contours in its slice (holes by exclusive
or), or on one of them: programs that trace masks put contours through the centres of the outermost voxels.
Attributes: DICOM PS3.3, C.8.8.5 and C.8.8.6.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from pydicom.dataset import Dataset

from palpate.errors import InputDataError
from palpate.findings import Finding
from palpate.images.label_image import LPS_TO_RAS, VoxelGrid
from palpate.images.named_labels import MAX_LABEL, MAX_NAME, NamedLabel, hex_colour, printable
from palpate.images.readers.dicom_dataset import Series, read_dataset, sentences, series_beside
from palpate.images.readers.merged_masks import Mask, merged
from palpate.images.readers.registry import StoredImage

CLOSED = ("CLOSED_PLANAR", "CLOSEDPLANAR_XOR")
ON_EDGE = 0.01  # of a voxel: contours are written with some six digits
MOST_TRIED = 20  # contours of a structure, to see how slices lie
SPARSE = 1.5  # slices between planes
ONE_PLANE = 0.1  # of the distance of slices, between points of one contour, and contours of one plane


@dataclass(frozen=True, slots=True)
class _Structure:
    """A structure's row, its closed contours by planes, and how many others it has.

    `heights` (n_planes,) in slices, ascending; `areas`: of each plane, contours (n, 2) of row and column.
    """

    row: NamedLabel
    heights: NDArray[np.float64]
    areas: tuple[tuple[NDArray[np.float64], ...], ...]
    n_open: int
    n_short: int

    @property
    def apart(self) -> float:
        """Distance of the planes, in slices."""
        return float(np.median(np.diff(self.heights))) if len(self.heights) > 1 else 1.0


def read(path: Path, grid: VoxelGrid | None) -> StoredImage:
    """Read the structures of `path` on the grid of their series where that lies beside the file, else on `grid`.

    Structures that overlap are made one label image as masks are. Raises `InputDataError` for whatever is wrong.
    """
    with sentences(path):
        dataset, sha256 = read_dataset(path)
        uids = (
            str(series.SeriesInstanceUID)
            for frame in dataset.get("ReferencedFrameOfReferenceSequence", ())
            for study in frame.get("RTReferencedStudySequence", ())
            for series in study.get("RTReferencedSeriesSequence", ())
        )
        series = series_beside(path, next(uids, "")) or (Series(grid) if grid else None)
        if series is None:
            raise InputDataError(
                f"the DICOM series that '{path}' was drawn on is not beside it, and without its slices contours have no"
                " voxels; copy it into the folder of that file, or into one there, or name a grey image on its grid as"
                " intensities_before or intensities_after of the case"
            )
        # the slices lie across the axis along which the first contours run least
        extent = np.zeros(3)
        for item in dataset.ROIContourSequence:
            for contour in (item.get("ContourSequence") or ())[:MOST_TRIED]:
                extent += np.ptp(series.grid.index(_points(contour)), axis=0)
        axis = int(np.argmin(extent))
        rows, columns = (n for k, n in enumerate(series.grid.shape) if k != axis)
        shape = (series.grid.shape[axis], rows, columns)
        # RAS mm -> index, the axis of the slices first
        inverse = np.asarray(np.linalg.inv(series.grid.affine), dtype=np.float64)
        structures = _structures(dataset, inverse[[axis, *(k for k in range(3) if k != axis), 3]], path)
        findings = _flaws(structures)
        masks = (Mask(each.row, _filled(each, shape)) for each in structures)
        labels, overlaps = merged(masks, shape)
    named = tuple(each.row for each in structures)
    digests = {"": sha256, **({"series": series.sha256} if series.sha256 else {})}
    return StoredImage(np.moveaxis(labels, 0, axis), series.grid.affine, named, digests, (*findings, *overlaps))


def _points(contour: Dataset) -> NDArray[np.float64]:
    """The points of a contour (n, 3), RAS mm."""
    return np.asarray(np.array(contour.ContourData, dtype=np.float64).reshape(-1, 3) * LPS_TO_RAS)


def _structures(dataset: Dataset, to_index: NDArray[np.float64], path: Path) -> list[_Structure]:
    """Those that have contours; numbered as in the file where its numbers can be labels, else from 1."""
    names = {int(roi.ROINumber): str(roi.get("ROIName", "")) for roi in dataset.StructureSetROISequence}
    drawn = [item for item in dataset.ROIContourSequence if item.get("ContourSequence")]
    numbers = [int(item.ReferencedROINumber) for item in drawn]
    if not numbers:
        raise InputDataError(f"'{path}' has no structure with a contour; export the structures again")
    usable = len(set(numbers)) == len(numbers) and 1 <= min(numbers) <= max(numbers) <= MAX_LABEL
    structures = []
    for place, (item, number) in enumerate(zip(drawn, numbers, strict=True), start=1):
        label = number if usable else place
        name = printable(names.get(number, "").strip())[:MAX_NAME] or f"structure {label}"
        colour = None
        if len(item.get("ROIDisplayColor") or ()) == 3:
            red, green, blue = (float(part) for part in item.ROIDisplayColor)
            colour = hex_colour(red, green, blue, top=255)
        contours, heights, areas = list[NDArray[np.float64]](), list[float](), list[list[NDArray[np.float64]]]()
        n_open = n_short = 0
        for contour in item.ContourSequence:
            points = _points(contour)
            if len(points) < 3:
                n_short += 1
            elif contour.get("ContourGeometricType") not in CLOSED:
                n_open += 1
            else:
                contours.append(points @ to_index[:3, :3].T + to_index[:3, 3])
        for points in sorted(contours, key=lambda points: float(points[:, 0].mean())):
            height, spread = float(points[:, 0].mean()), float(np.ptp(points[:, 0]))
            if not spread <= ONE_PLANE:
                raise InputDataError(
                    f"a contour of '{name}' in '{path}' runs over {spread:.3g} slices of its series, not one;"
                    " export the structures on the slices that they were drawn on"
                )
            if not heights or height - heights[-1] > ONE_PLANE:
                heights.append(height)
                areas.append([])
            areas[-1].append(points[:, 1:])
        row, planes = NamedLabel(label, name, colour), tuple(map(tuple, areas))
        structures.append(_Structure(row, np.array(heights), planes, n_open, n_short))
    return structures


def _flaws(structures: Sequence[_Structure]) -> tuple[Finding, ...]:
    """What was left out, and what was filled in."""
    found: list[Finding] = []
    lines = [
        f"'{each.row.name}' ({' and '.join(parts)})"
        for each in structures
        if (parts := [f"{n} {kind}" for n, kind in ((each.n_open, "open"), (each.n_short, "of under 3 points")) if n])
    ]
    if lines:
        text = f"contours that enclose nothing were left out: {', '.join(lines)}; close them, or draw them again"
        found.append(Finding("open-contours", text))
    sparse = [f"'{each.row.name}' ({each.apart:.3g} slices)" for each in structures if each.apart > SPARSE]
    if sparse:
        text = (
            f"contours are more than a slice apart: {', '.join(sparse)}; slices between them took those of the nearest"
            " plane, so that surfaces have steps: interpolate the contours"
        )
        found.append(Finding("sparse-contours", text))
    return tuple(found)


def _filled(structure: _Structure, shape: tuple[int, int, int]) -> NDArray[np.bool_]:
    """The voxels inside; a slice takes the contours of the plane nearest to it, within half the planes' distance."""
    inside = np.zeros(shape, dtype=bool)
    half = max(0.5, 0.5 * structure.apart)
    for k in range(shape[0] if len(structure.heights) else 0):
        nearest = int(np.argmin(np.abs(structure.heights - k)))
        if -half < k - structure.heights[nearest] <= half:
            inside[k] = _area(structure.areas[nearest], shape[1:])
    return inside


def _area(polygons: Sequence[NDArray[np.float64]], shape: tuple[int, int]) -> NDArray[np.bool_]:
    """Pixels (n_rows, n_columns) with centres inside an odd number of polygons (n, 2) of row and column, or on one.

    Every row is cut by every edge; from a crossing on, all pixels to the right change sides.
    """
    starts = np.concatenate(polygons)
    ends = np.concatenate([np.roll(polygon, -1, axis=0) for polygon in polygons])
    crossings = np.zeros((shape[0], shape[1] + 1), dtype=np.int64)
    on = np.zeros(shape, dtype=bool)
    row, column = _cuts(starts, ends, shape[0], margin=0.0)
    np.add.at(crossings, (row, np.clip(np.ceil(column), 0, shape[1]).astype(np.int64)), 1)
    row, column = _cuts(starts, ends, shape[0], margin=ON_EDGE)
    whole = np.rint(column)
    near = (np.abs(column - whole) <= ON_EDGE) & (whole >= 0) & (whole < shape[1])
    on[row[near], whole[near].astype(np.int64)] = True
    level = np.rint(starts[:, 0])
    along = (np.abs(starts[:, 0] - level) <= ON_EDGE) & (np.abs(ends[:, 0] - level) <= ON_EDGE)
    for edge in np.flatnonzero(along & (level >= 0) & (level < shape[0])):  # edges that run along a row
        low, high = np.sort([starts[edge, 1], ends[edge, 1]])
        inside = slice(max(int(np.ceil(low - ON_EDGE)), 0), max(int(np.floor(high + ON_EDGE)) + 1, 0))
        on[int(level[edge]), inside] = True
    return np.asarray((np.cumsum(crossings, axis=1)[:, :-1] % 2 == 1) | on)


def _cuts(
    starts: NDArray[np.float64], ends: NDArray[np.float64], n_rows: int, *, margin: float
) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Rows that edges cross, and the column of each crossing; with a margin also those that an edge ends on."""
    low, high = np.minimum(starts[:, 0], ends[:, 0]), np.maximum(starts[:, 0], ends[:, 0])
    sloped = high > low
    first = np.clip(np.ceil(low - margin), 0, n_rows)
    last = np.clip(np.ceil(high) if margin == 0.0 else np.floor(high + margin) + 1, 0, n_rows)
    count = np.where(sloped, np.maximum(last - first, 0), 0).astype(np.int64)
    edge = np.repeat(np.arange(len(count)), count)
    row = (first[edge] + np.arange(len(edge)) - np.repeat(np.cumsum(count) - count, count)).astype(np.int64)
    share = np.clip((row - starts[edge, 0]) / (ends[edge, 0] - starts[edge, 0]), 0.0, 1.0)
    return row, starts[edge, 1] + share * (ends[edge, 1] - starts[edge, 1])
