"""DICOM-SEG: binary and labelmap segmentations through highdicom, with the names and colours of their segments."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
from highdicom.color import CIELabColor
from highdicom.seg import Segmentation

from palpate.errors import InputDataError
from palpate.findings import Finding
from palpate.images.label_image import VoxelGrid
from palpate.images.named_labels import MAX_NAME, NamedLabel, hex_colour, printable
from palpate.images.readers.dicom_dataset import LPS_AFFINE, Series, read_dataset, sentences, series_beside
from palpate.images.readers.merged_masks import Mask, merged
from palpate.images.readers.reference_grid import on_grid
from palpate.images.readers.registry import StoredImage
from palpate.images.readers.values import to_canonical
from palpate.images.readers.voxel_stream import check_size

MOST_SEGMENTS = 1000


def read(path: Path, grid: VoxelGrid | None) -> StoredImage:
    """Read the segments of `path`, on the grid of their series where that lies beside the file, else on `grid`.

    Segments that overlap are made one label image as masks are. Raises `InputDataError` for whatever is wrong.
    """
    with sentences(path):
        dataset, sha256 = read_dataset(path)
        if dataset.SegmentationType == "FRACTIONAL":
            raise InputDataError(
                f"'{path}' is a fractional segmentation, which gives a probability or an occupancy in each voxel and no"
                " border; threshold it, and save it as a binary or labelmap segmentation"
            )
        segmentation = Segmentation.from_dataset(dataset, copy=False)
        numbers = [int(number) for number in segmentation.segment_numbers]
        if not 1 <= len(numbers) <= MOST_SEGMENTS:
            raise InputDataError(f"'{path}' has {len(numbers)} segments; 1 to {MOST_SEGMENTS} are read")
        geometry = segmentation.get_volume_geometry()
        if geometry is None:
            raise InputDataError(
                f"the slices of '{path}' are not evenly spaced, so that no image can be made of them; resample it"
            )
        check_size(tuple(geometry.spatial_shape), 0, path, available=0, packed=False)
        rows: list[NamedLabel] = []
        for item in segmentation.SegmentSequence:
            number, colour = int(item.SegmentNumber), None
            if number not in numbers:
                continue
            if "RecommendedDisplayCIELabValue" in item:
                lab = CIELabColor.from_dicom_value(item.RecommendedDisplayCIELabValue)
                red, green, blue = lab.to_rgb(clip=True)
                colour = hex_colour(red, green, blue, top=255)
            name = printable(str(item.get("SegmentLabel", "")).strip())[:MAX_NAME] or f"segment {number}"
            rows.append(NamedLabel(number, name, colour))
        findings: tuple[Finding, ...] = ()
        if dataset.SegmentationType == "LABELMAP":
            labels = np.asarray(segmentation.get_volume(combine_segments=True, dtype=np.uint16).array)
        else:
            volumes = (segmentation.get_volume(segment_numbers=[row.label], dtype=np.uint8) for row in rows)
            masks = (Mask(row, np.asarray(of.array)[..., 0] > 0) for row, of in zip(rows, volumes, strict=True))
            labels, findings = merged(masks, tuple(geometry.spatial_shape))
        affine = LPS_AFFINE @ geometry.affine
        referenced = [str(of.SeriesInstanceUID) for of in dataset.get("ReferencedSeriesSequence") or ()]
        series = series_beside(path, referenced) or (Series(grid) if grid else None)
        return _completed(StoredImage(labels, affine, tuple(rows), {"": sha256}, findings), series)


def _completed(image: StoredImage, series: Series | None) -> StoredImage:
    """The image with the slices that the file leaves out as empty, which only its series can tell."""
    if series is not None:
        labels, affine = to_canonical(image.values, image.affine)
        whole = on_grid(replace(image, values=labels, affine=affine), series.grid)
        if whole is not None:
            return replace(whole, digests={**image.digests, **({"series": series.sha256} if series.sha256 else {})})
    labels = image.values
    if not (labels[0].any() and labels[-1].any()):
        return image
    text = (
        "the image ends with the first and the last slice that a segment reaches, as files of this kind leave out empty"
        " slices; copy the DICOM series that it was made on beside it, or name a grey image on its grid as intensities"
    )
    return replace(image, findings=(*image.findings, Finding("cropped", text)))
