"""RTSTRUCT: planar contours made a label image on the grid of the series that they were drawn on.

Attributes: DICOM PS3.3, C.8.8.5 and C.8.8.6.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from pydicom.dataset import Dataset

from palpate.errors import InputDataError
from palpate.findings import Code, Finding
from palpate.images.label_image import LPS_TO_RAS, VoxelGrid
from palpate.images.named_labels import MAX_LABEL, MAX_NAME, NamedLabel, hex_colour, printable
from palpate.images.readers.dicom_dataset import Series, read_dataset, sentences, series_beside
from palpate.images.readers.merged_masks import Mask, merged
from palpate.images.readers.planar_contours import Contour, body, distinct
from palpate.images.readers.registry import StoredImage

EXCLUSIVE = "CLOSEDPLANAR_XOR"
CLOSED = ("CLOSED_PLANAR", EXCLUSIVE)
MOST_TRIED = 20  # contours of a structure, to see how slices lie
MOST_SHOWN = 8  # structures, or slices of one, in a sentence
ONE_PLANE = 0.1  # of the distance of slices, between points of one contour, and contours of one plane


@dataclass(frozen=True, slots=True)
class _Structure:
    """A structure's row, its closed contours by planes at ascending `heights` (n_planes,) in slices.

    flaws: what was left out or is cut, in words.
    """

    row: NamedLabel
    heights: NDArray[np.float64]
    planes: tuple[list[Contour], ...]
    exclusive: bool
    flaws: tuple[str, ...]


def read(path: Path, grid: VoxelGrid | None) -> StoredImage:
    """Read the structures of `path` on the grid of their series where that lies beside the file, else on `grid`.

    Structures that overlap are made one label image as masks are. Raises `InputDataError` for whatever is wrong.
    """
    with sentences(path):
        dataset, sha256 = read_dataset(path)
        drawn: dict[int, list[Dataset]] = {int(roi.ROINumber): [] for roi in dataset.StructureSetROISequence}
        for item in dataset.ROIContourSequence:
            drawn.setdefault(int(item.ReferencedROINumber), []).extend(item.get("ContourSequence") or ())
        tried = [contour for contours in drawn.values() for contour in contours[:MOST_TRIED]]
        frames = {
            str(series.SeriesInstanceUID): str(frame.get("FrameOfReferenceUID"))
            for frame in dataset.get("ReferencedFrameOfReferenceSequence", ())
            for study in frame.get("RTReferencedStudySequence", ())
            for series in study.get("RTReferencedSeriesSequence", ())
        }
        slices = [str(of.ReferencedSOPInstanceUID) for each in tried for of in each.get("ContourImageSequence", ())]
        series = series_beside(path, [*frames] or slices) or (Series(grid) if grid else None)
        if series is None:
            raise InputDataError(
                f"the DICOM series that '{path}' was drawn on is not beside it, and without its slices contours have no"
                " voxels; copy it into the folder of that file, or into one there, or name a grey image on its grid as"
                " intensities_before or intensities_after of the case"
            )
        # the slices lie across the axis along which the contours run least
        extent = sum((np.ptp(series.grid.index(_points(contour)), axis=0) for contour in tried), np.zeros(3))
        axis = int(np.argmin(extent))
        away = set(frames.values()) - {frames.get(series.uid, "")} if series.uid else set[str]()
        structures = [
            _structure(row, [] if frame in away else contours, series.grid, axis, path)
            for row, frame, contours in _rows(dataset, drawn)
        ]
        if not any(each.planes for each in structures):
            raise InputDataError(f"'{path}' has no structure with a contour that encloses something; export it again")
        shape = tuple(series.grid.shape[k] for k in (axis, *(k for k in range(3) if k != axis)))
        findings = list[Finding]()
        labels, overlaps = merged(
            _masks(structures, (shape[0], shape[1], shape[2]), series.grid, axis, findings), shape
        )
    named = tuple(each.row for each in structures if each.planes)
    digests = {"": sha256, **({"series": series.sha256} if series.sha256 else {})}
    return StoredImage(np.moveaxis(labels, 0, axis), series.grid.affine, named, digests, (*findings, *overlaps))


def _points(contour: Dataset) -> NDArray[np.float64]:
    """The points of a contour (n, 3), RAS mm."""
    return np.asarray(np.array(contour.ContourData, dtype=np.float64).reshape(-1, 3) * LPS_TO_RAS)


def _rows(dataset: Dataset, drawn: Mapping[int, list[Dataset]]) -> Iterator[tuple[NamedLabel, str, list[Dataset]]]:
    """Row, frame of reference and contours of each; numbered as in the file where that can be labels, else from 1."""
    rois = {int(roi.ROINumber): roi for roi in dataset.StructureSetROISequence}
    colours = {int(item.ReferencedROINumber): item.get("ROIDisplayColor") or () for item in dataset.ROIContourSequence}
    names = {number: printable(str(roi.get("ROIName", "")).strip())[: MAX_NAME - 20] for number, roi in rois.items()}
    often = Counter(names.get(number) for number, contours in drawn.items() if contours)
    usable = 1 <= min(drawn, default=0) <= max(drawn, default=0) <= MAX_LABEL
    for place, (number, contours) in enumerate(drawn.items(), start=1):
        name = names.get(number) or f"structure {number}"
        name = f"{name} (ROI {number})" if often[name] > 1 else name
        rgb = [float(part) for part in colours.get(number, ())]
        colour = hex_colour(*rgb, top=255) if len(rgb) == 3 else None
        frame = str(rois.get(number, Dataset()).get("ReferencedFrameOfReferenceUID"))
        yield NamedLabel(number if usable else place, name, colour), frame, contours


def _structure(row: NamedLabel, contours: list[Dataset], grid: VoxelGrid, axis: int, path: Path) -> _Structure:
    order = [axis, *(k for k in range(3) if k != axis)]
    several = [(of.get("ContourGeometricType"), grid.index(_points(of))[:, order]) for of in contours]
    closed = [points for kind, points in several if len(points) >= 3 and kind in CLOSED]
    heights, planes = list[float](), list[list[Contour]]()
    for points in sorted(closed, key=lambda points: float(points[:, 0].mean())):
        height, spread = float(points[:, 0].mean()), float(np.ptp(points[:, 0]))
        if not spread <= ONE_PLANE:
            raise InputDataError(
                f"a contour of '{row.name}' in '{path}' runs over {spread:.3g} slices of its series, not one;"
                " export the structures on the slices that they were drawn on"
            )
        if not heights or height - heights[-1] > ONE_PLANE:
            heights.append(height)
            planes.append([])
        planes[-1].append(points[:, 1:])
    once = tuple(map(distinct, planes))
    n_short = sum(len(points) < 3 for _, points in several)
    border = np.array(grid.shape)[order] - 0.5 + ONE_PLANE
    beyond = [np.any((points < -0.5 - ONE_PLANE) | (points > border), axis=1) for points in closed]
    counts = {
        "open": len(several) - n_short - len(closed),
        "of under 3 points": n_short,
        "in the file twice": len(closed) - sum(map(len, once)),
    }
    flaws = [f"{n} {kind}" for kind, n in counts.items() if n]
    if share := float(np.mean(np.concatenate(beyond))) if beyond else 0.0:
        flaws.append(f"{share:.1%} of its points beyond the series")
    exclusive = any(kind == EXCLUSIVE for kind, _ in several)
    return _Structure(row, np.array(heights), once, exclusive, tuple(flaws if several else ["none on this series"]))


def _masks(
    structures: list[_Structure], shape: tuple[int, int, int], grid: VoxelGrid, axis: int, findings: list[Finding]
) -> Iterator[Mask]:
    """The voxels of each structure in turn; after the last, `findings` tell what was left out or filled."""
    left_out, changed = list[str](), list[str]()
    middle = 0.5 * (np.array(grid.shape) - 1.0)

    def places(slices: list[int]) -> str:
        index = np.where(np.arange(3) == axis, np.array(slices)[:, None], middle)
        heights = ", ".join(f"{mm:.4g}" for mm in grid.world(index[:MOST_SHOWN])[:, axis])
        return f"{len(slices)} at {'RAS'[axis]} {heights}{', ...' * (len(slices) > MOST_SHOWN)} mm"

    for each in structures:
        flaws = list(each.flaws)
        if each.planes:
            inside, noted = body(each.heights, each.planes, shape, exclusive=each.exclusive)
            flaws += [] if inside.any() else ["no voxel"]
            words = [f"{places(slices)} {kind}" for kind, slices in noted.items() if slices]
            apart = sorted({round(float(step), 2) for step in np.diff(each.heights) * grid.spacing[axis]})
            every = " to ".join(f"{mm:.3g}" for mm in apart[:: max(len(apart) - 1, 1)])
            changed += [f"'{each.row.name}' ({'; '.join(words)}; its planes every {every} mm)"] if words else []
            yield Mask(each.row, inside)
        left_out += [f"'{each.row.name}' ({' and '.join(flaws)})"] if flaws else []
    said: tuple[tuple[Code, str, list[str]], ...] = (
        ("open-contours", "contours were left out, or are cut with the series", left_out),
        ("sparse-contours", f"slices every {grid.spacing[axis]:.3g} mm are not as contours were drawn", changed),
    )
    for code, text, parts in said:
        shown = f"{', '.join(parts[:MOST_SHOWN])}{', ...' * (len(parts) > MOST_SHOWN)}"
        findings += [Finding(code, f"{text}: {shown}; look at them, or draw them")] if parts else []
