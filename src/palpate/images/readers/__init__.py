"""Readers of image files, one file a format; importing this package registers them all."""

from palpate.images.readers.nifti import write_label_image, write_scalar_image
from palpate.images.readers.read import read_intensities, read_label_image

__all__ = ["read_intensities", "read_label_image", "write_label_image", "write_scalar_image"]
