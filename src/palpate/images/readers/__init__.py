"""Readers of image files, one file a format; importing this package registers them all.

Other packages bring theirs as entry points `palpate.readers`, each an `ImageFormat`.
"""

from palpate.images.readers import dicom as dicom
from palpate.images.readers import mask_folder as mask_folder
from palpate.images.readers import metaimage as metaimage
from palpate.images.readers import nrrd as nrrd
from palpate.images.readers.isolation import ReadLimits as ReadLimits
from palpate.images.readers.nifti import write_displacement_field as write_displacement_field
from palpate.images.readers.nifti import write_label_image as write_label_image
from palpate.images.readers.nifti import write_scalar_image as write_scalar_image
from palpate.images.readers.read import read_intensities as read_intensities
from palpate.images.readers.read import read_label_image as read_label_image
from palpate.images.readers.registry import ImageFormat as ImageFormat
from palpate.images.readers.registry import StoredImage as StoredImage
