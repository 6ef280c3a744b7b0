"""DICOM-SEG: binary and labelmap segmentations through highdicom, with the names and colours of their segments."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
from highdicom.color import CIELabColor
from highdicom.seg import Segmentation
from pydicom.dataset import Dataset

from palpate.errors import InputDataError
from palpate.findings import Finding
from palpate.images.label_image import VoxelGrid
from palpate.images.named_labels import NamedLabel, given_name, hex_colour
from palpate.images.readers.dicom_dataset import LPS_AFFINE, read_dataset, series_beside
from palpate.images.readers.merged_masks import Mask, merged
from palpate.images.readers.reference_grid import on_grid
from palpate.images.readers.registry import StoredImage
from palpate.images.readers.values import canonical
from palpate.images.readers.voxel_stream import check_size

MOST_SEGMENTS = 1000
CROPPED = (
    "the image ends at the first and the last slice that has a segment, because DICOM-SEG leaves out empty slices. Copy"
    " the DICOM series beside the file, or name a grey image on its grid as intensities."
)


def read(path: Path, grid: VoxelGrid | None) -> StoredImage:
    """Read the segments of `path`, on the grid of their series where that lies beside the file, else on `grid`.

    Segments that overlap are made one label image as masks are. Where nothing tells which slices the file leaves out,
    there is a finding. Raises `InputDataError` for whatever is wrong.
    """
    dataset, sha256 = read_dataset(path)
    if dataset.SegmentationType == "FRACTIONAL":
        advice = "threshold it, and save it as a binary or labelmap segmentation"
        raise InputDataError(f"'{path}' is a fractional segmentation, which has no sharp surface; {advice}")
    segmentation = Segmentation.from_dataset(dataset, copy=False)
    numbers = [int(number) for number in segmentation.segment_numbers]
    if not 1 <= len(numbers) <= MOST_SEGMENTS:
        raise InputDataError(f"'{path}' has {len(numbers)} segments; 1 to {MOST_SEGMENTS} are read")
    geometry = segmentation.get_volume_geometry()
    if geometry is None:
        raise InputDataError(f"the slices of '{path}' are not evenly spaced; resample it on an even grid")
    shape = tuple(geometry.spatial_shape)
    check_size(shape, path)
    rows = [_row(item) for item in segmentation.SegmentSequence if int(item.SegmentNumber) in numbers]
    findings: tuple[Finding, ...] = ()
    if dataset.SegmentationType == "LABELMAP":
        labels = np.asarray(segmentation.get_volume(combine_segments=True, dtype=np.uint16).array)
    else:
        volumes = (segmentation.get_volume(segment_numbers=[row.label], dtype=np.uint8) for row in rows)
        masks = (Mask(row, np.asarray(of.array)[..., 0] > 0) for row, of in zip(rows, volumes, strict=True))
        labels, findings = merged(masks, shape)
    image = StoredImage(labels, LPS_AFFINE @ geometry.affine, tuple(rows), {"": sha256}, findings)
    referenced = [str(of.SeriesInstanceUID) for of in dataset.get("ReferencedSeriesSequence") or ()]
    series = series_beside(path, referenced, grid)
    if series and (whole := on_grid(canonical(image), series.grid)):
        return replace(whole, digests={**image.digests, **series.digests})
    if labels[0].any() and labels[-1].any():
        return replace(image, findings=(*findings, Finding("cropped", CROPPED)))
    return image


def _row(item: Dataset) -> NamedLabel:
    """Number, name and colour of a segment."""
    number, colour = int(item.SegmentNumber), None
    if "RecommendedDisplayCIELabValue" in item:
        colour = hex_colour(CIELabColor.from_dicom_value(item.RecommendedDisplayCIELabValue).to_rgb(clip=True), top=255)
    return NamedLabel(number, given_name(item.get("SegmentLabel", ""), f"segment {number}"), colour)
