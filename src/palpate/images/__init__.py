"""Label images: reading, tissues, distance maps, alignment, checks."""

from __future__ import annotations

from typing import TYPE_CHECKING

from palpate.front_door import front_door

if TYPE_CHECKING:
    from palpate.images.distance import observation_width as observation_width
    from palpate.images.distance import smoothing_width as smoothing_width
    from palpate.images.label_image import LabelImage as LabelImage
    from palpate.images.label_image import VoxelGrid as VoxelGrid
    from palpate.images.label_table import read_label_table as read_label_table
    from palpate.images.readers import read_intensities as read_intensities
    from palpate.images.readers import read_label_image as read_label_image
    from palpate.images.readers import write_label_image as write_label_image
    from palpate.images.segmentation import Segmentation as Segmentation
    from palpate.images.segmentation import segment as segment
    from palpate.images.tissue import FieldPrior as FieldPrior
    from palpate.images.tissue import Role as Role
    from palpate.images.tissue import Tissue as Tissue

__getattr__, __dir__ = front_door(__name__)
