"""Readers of image files and label tables, one file a format; importing this package registers them all.

Other packages bring theirs as entry points `palpate.readers`, each an `ImageFormat`.
"""

from palpate.images.readers import column_tables, dicom, line_tables, mask_folder, metaimage, nrrd, table_json
from palpate.images.readers.isolation import ReadLimits
from palpate.images.readers.nifti import write_displacement_field, write_label_image, write_scalar_image
from palpate.images.readers.read import read_intensities, read_label_image
from palpate.images.readers.registry import ImageFormat, StoredImage

__all__ = [
    "ImageFormat",
    "ReadLimits",
    "StoredImage",
    "column_tables",
    "dicom",
    "line_tables",
    "mask_folder",
    "metaimage",
    "nrrd",
    "read_intensities",
    "read_label_image",
    "table_json",
    "write_displacement_field",
    "write_label_image",
    "write_scalar_image",
]
