"""Label images: reading, tissues, distance maps, alignment, checks."""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from palpate.images.distance import observation_width, smoothing_width
    from palpate.images.label_image import LabelImage, VoxelGrid
    from palpate.images.label_table import read_label_table
    from palpate.images.readers import read_intensities, read_label_image, write_label_image
    from palpate.images.segmentation import Segmentation, segment
    from palpate.images.tissue import FieldPrior, Role, Tissue

__all__ = [
    "FieldPrior",
    "LabelImage",
    "Role",
    "Segmentation",
    "Tissue",
    "VoxelGrid",
    "observation_width",
    "read_intensities",
    "read_label_image",
    "read_label_table",
    "segment",
    "smoothing_width",
    "write_label_image",
]

_HOMES = {
    "FieldPrior": "palpate.images.tissue",
    "LabelImage": "palpate.images.label_image",
    "Role": "palpate.images.tissue",
    "Segmentation": "palpate.images.segmentation",
    "Tissue": "palpate.images.tissue",
    "VoxelGrid": "palpate.images.label_image",
    "observation_width": "palpate.images.distance",
    "read_intensities": "palpate.images.readers",
    "read_label_image": "palpate.images.readers",
    "read_label_table": "palpate.images.label_table",
    "segment": "palpate.images.segmentation",
    "smoothing_width": "palpate.images.distance",
    "write_label_image": "palpate.images.readers",
}


def __getattr__(name: str) -> Any:
    """Import a name when it is first used: a part of this layer is often wanted alone, and quickly."""
    if name not in _HOMES:
        raise AttributeError(f"module 'palpate.images' has no attribute '{name}'")
    return getattr(import_module(_HOMES[name]), name)
