"""RTSTRUCT: planar contours made a label image on the grid of the series that they were drawn on.

Attributes: DICOM PS3.3, C.8.8.5 and C.8.8.6.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from pydicom.dataset import Dataset

from palpate.errors import InputDataError
from palpate.findings import Code, Finding, listing, some
from palpate.images.label_image import LPS_TO_RAS, VoxelGrid
from palpate.images.named_labels import MAX_LABEL, MAX_NAME, NamedLabel, given_name, hex_colour
from palpate.images.readers.dicom_dataset import read_dataset, series_beside
from palpate.images.readers.merged_masks import Mask, merged
from palpate.images.readers.planar_contours import Contour, body, distinct
from palpate.images.readers.registry import StoredImage

EXCLUSIVE = "CLOSEDPLANAR_XOR"
CLOSED = ("CLOSED_PLANAR", EXCLUSIVE)
MOST_TRIED = 20  # contours of a structure, to see how slices lie
MOST_SHOWN = 3  # slices of a structure, in a sentence
ONE_PLANE = 0.1  # of the distance of slices, between points of one contour, and contours of one plane
TOLD: Mapping[Code, str] = {
    "open-contours": "contours were left out, or are cut off where the series ends: ",
    "sparse-contours": "slices have no contour of their own, or contours that cross: ",
}


def read(path: Path, grid: VoxelGrid | None) -> StoredImage:
    """Read the structures of `path` on the grid of their series where that lies beside the file, else on `grid`.

    Structures that overlap are made one label image as masks are. Raises `InputDataError` for whatever is wrong.
    """
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
    series = series_beside(path, [*frames] or slices, grid)
    if series is None:
        advice = "copy it there, or name a grey image on its grid as intensities_before or intensities_after"
        raise InputDataError(f"the DICOM series on which '{path}' was drawn is not in the same folder; {advice}")
    # the slices lie across the axis along which the contours run least
    extent = sum((np.ptp(series.grid.index(_points(contour)), axis=0) for contour in tried), np.zeros(3))
    order = sorted(range(3), key=lambda axis: axis != int(np.argmin(extent)))
    away = set(frames.values()) - {frames.get(series.uid, "")} if series.uid else set[str]()
    rows, notes = list[NamedLabel](), {code: list[str]() for code in TOLD}

    def masks() -> Iterator[Mask]:
        for row, frame, contours in _rows(dataset, drawn):
            inside, *said = _filled(row, [] if frame in away else contours, series.grid, order, path)
            for code, words in zip(TOLD, said, strict=True):
                notes[code] += [f"'{row.name}' ({words})"] if words else []
            if inside is not None:
                rows.append(row)
                yield Mask(row, inside)

    labels, overlaps = merged(masks(), tuple(series.grid.shape[k] for k in order))
    if not rows:
        raise InputDataError(f"'{path}' has no structure with a contour that encloses something; export it again")
    findings = [
        Finding(code, listing(TOLD[code], parts, ". Look at them, and draw again what is wrong."))
        for code, parts in notes.items()
        if parts
    ]
    labels, digests = np.moveaxis(labels, 0, order[0]), {"": sha256, **series.digests}
    return StoredImage(labels, series.grid.affine, tuple(rows), digests, (*findings, *overlaps))


def _points(contour: Dataset) -> NDArray[np.float64]:
    """The points of a contour (n, 3), RAS mm."""
    return np.asarray(np.array(contour.ContourData, dtype=np.float64).reshape(-1, 3) * LPS_TO_RAS)


def _rows(dataset: Dataset, drawn: Mapping[int, list[Dataset]]) -> Iterator[tuple[NamedLabel, str, list[Dataset]]]:
    """Row, frame of reference and contours of each; numbered as in the file where that can be labels, else from 1."""
    rois = {number: Dataset() for number in drawn} | {int(of.ROINumber): of for of in dataset.StructureSetROISequence}
    colours = {int(item.ReferencedROINumber): item.get("ROIDisplayColor") or () for item in dataset.ROIContourSequence}
    names = {n: given_name(roi.get("ROIName", ""), f"structure {n}")[: MAX_NAME - 20] for n, roi in rois.items()}
    often = Counter(names[number] for number, contours in drawn.items() if contours)
    usable = 1 <= min(drawn, default=0) <= max(drawn, default=0) <= MAX_LABEL
    for place, (number, contours) in enumerate(drawn.items(), start=1):
        name = names[number] + f" (ROI {number})" * (often[names[number]] > 1)
        colour = hex_colour([float(part) for part in colours.get(number, ())], top=255)
        frame = str(rois[number].get("ReferencedFrameOfReferenceUID"))
        yield NamedLabel(number if usable else place, name, colour), frame, contours


def _filled(
    row: NamedLabel, contours: list[Dataset], grid: VoxelGrid, order: Sequence[int], path: Path
) -> tuple[NDArray[np.bool_] | None, str, str]:
    """A structure's voxels in the order of axes; in words what was left out or cut, and what was filled or joined."""
    several = [(of.get("ContourGeometricType"), grid.index(_points(of))[:, order]) for of in contours]
    closed = [points for kind, points in several if len(points) >= 3 and kind in CLOSED]
    planes = _planes(closed, f"a contour of '{row.name}' in '{path}'")
    heights, n_short = np.array([*planes]), sum(len(points) < 3 for _, points in several)
    counts = {
        "open": len(several) - n_short - len(closed),
        "with under 3 points": n_short,
        "twice in the file": len(closed) - sum(map(len, planes.values())),
    }
    flaws = [f"{n} {kind}" for kind, n in counts.items() if n] if several else ["none on this series"]
    if not closed:
        return None, " and ".join(flaws), ""
    shape = np.array(grid.shape)[order]
    points, middle = np.concatenate(closed), 0.5 * (shape - 1.0)
    if share := float(np.mean(np.any(np.abs(points - middle) > middle + 0.5 + ONE_PLANE, axis=1))):
        flaws.append(f"{share:.1%} of its points beyond the series")
    exclusive = any(kind == EXCLUSIVE for kind, _ in several)
    inside, noted = body(heights, [*planes.values()], tuple(shape), exclusive=exclusive)
    flaws += [] if inside.any() else ["no voxel"]
    words = []
    for kind, slices in noted.items():
        index = np.array([[k, *middle[1:]] for k in slices]).reshape(-1, 3)[:, np.argsort(order)]
        places = some([f"{mm:.4g}" for mm in grid.world(index)[:, order[0]]], most=MOST_SHOWN)
        words += [f"{len(slices)} {kind}, at {'RAS'[order[0]]} = {places} mm"] if slices else []
    apart = np.sort(np.diff(heights)) * grid.spacing[order[0]]
    every = " to ".join(dict.fromkeys(f"{mm:.3g}" for mm in (*apart[:1], *apart[-1:])))
    words += [f"contours every {every} mm"] if words else []
    return inside, " and ".join(flaws), "; ".join(words)


def _planes(closed: Sequence[Contour], called: str) -> dict[float, list[Contour]]:
    """By ascending heights in slices the contours that lie there, each once."""
    planes: dict[float, list[Contour]] = {}
    for points in sorted(closed, key=lambda points: float(points[:, 0].mean())):
        height, spread = float(points[:, 0].mean()), float(np.ptp(points[:, 0]))
        if not spread <= ONE_PLANE:
            flaw = f"runs across {spread:.3g} slices of its series, not within one"
            raise InputDataError(f"{called} {flaw}; draw the structures on the slices of the series")
        if not planes or height - max(planes) > ONE_PLANE:
            planes[height] = []
        planes[max(planes)].append(points[:, 1:])
    return {height: distinct(contours) for height, contours in planes.items()}
