"""DICOM files: which of them are segmentations, and who reads those; a plain series is refused with what converts it.

Reading takes the extra `dicom` (highdicom, pydicom), whose modules are imported when such a file comes. Class UIDs:
DICOM PS3.6, annex A.
"""

from __future__ import annotations

import re
import warnings
from importlib import import_module
from pathlib import Path

from palpate.errors import InputDataError, PalpateError, ResourceError
from palpate.images.label_image import VoxelGrid
from palpate.images.readers.registry import ImageFormat, StoredImage, register
from palpate.images.readers.voxel_stream import opened

MARK = b"DICM"  # at byte 128
SOP_CLASS = re.compile(rb"\x02\x00\x02\x00UI(..)([0-9.]{1,64})\0?", re.DOTALL)  # in the file meta information
READERS = {
    b"1.2.840.10008.5.1.4.1.1.66.4": "dicom_segmentation",  # Segmentation Storage
    b"1.2.840.10008.5.1.4.1.1.66.7": "dicom_segmentation",  # Label Map Segmentation Storage
    b"1.2.840.10008.5.1.4.1.1.481.3": "dicom_contours",  # RT Structure Set Storage
}


def read_dicom(path: Path, grid: VoxelGrid | None = None) -> StoredImage:
    """Read the segments of a DICOM-SEG, or the contours of an RTSTRUCT, as one label image.

    `grid` is taken where the series that it refers to is not beside it. Raises `InputDataError` for other classes and
    damaged files, `ResourceError` without the extra `dicom`.
    """
    with opened(path) as file:
        head = file.read(2000)
    if head[128:132] != MARK:
        raise InputDataError(f"'{path}' does not begin as a DICOM file does; export the segmentation again")
    found = SOP_CLASS.search(head)
    if found is None or found[2] not in READERS:
        raise refused_series(path)
    try:
        module = import_module(f"palpate.images.readers.{READERS[found[2]]}")
    except ImportError as error:
        flaw = "is a DICOM segmentation, and the libraries that read it are not installed"
        raise ResourceError(f"'{path}' {flaw}: run pip install \"palpate[dicom]\"") from error
    try:
        with warnings.catch_warnings(action="ignore"):
            image: StoredImage = module.read(path, grid)
    except (PalpateError, MemoryError):
        raise
    except Exception as error:  # whose words may quote a patient's data
        flaw = f"is a DICOM segmentation that cannot be read ({type(error).__name__})"
        raise InputDataError(f"'{path}' {flaw}; export it again") from error
    return image


def refused_series(path: Path) -> InputDataError:
    """The sentence for DICOM that holds no segmentation."""
    return InputDataError(
        f"'{path}' is a DICOM image or series, not a segmentation: convert it to NIfTI with dcm2niix or 3D Slicer,"
        " segment it, and name the segmentation (a DICOM-SEG or an RTSTRUCT by its file)"
    )


register(ImageFormat("DICOM", (".dcm", ".dicom"), read_dicom, patience=4, mark=MARK, read_on=read_dicom))
