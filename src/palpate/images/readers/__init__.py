"""Readers of image files, one file a format; importing this package registers them all.

Other packages bring theirs as entry points `palpate.readers`, each an `ImageFormat`.
"""

from palpate.images.readers import dicom, mask_folder, metaimage, nrrd
from palpate.images.readers.isolation import ReadLimits
from palpate.images.readers.nifti import write_displacement_field, write_label_image, write_scalar_image
from palpate.images.readers.read import read_intensities, read_label_image
from palpate.images.readers.registry import ImageFormat, StoredImage

__all__ = [
    "ImageFormat",
    "ReadLimits",
    "StoredImage",
    "dicom",
    "mask_folder",
    "metaimage",
    "nrrd",
    "read_intensities",
    "read_label_image",
    "write_displacement_field",
    "write_label_image",
    "write_scalar_image",
]
