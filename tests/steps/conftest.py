"""Two label images with their names, from which a case can be begun."""

from __future__ import annotations

import json

import numpy as np
import pytest

from palpate.images.label_image import LabelImage, VoxelGrid
from palpate.images.readers import write_label_image


@pytest.fixture
def folder(tmp_path):
    grid = VoxelGrid((24, 24, 24), np.diag([2.0, 2.0, 2.0, 1.0]))
    for name, wall in (("before", 8), ("after", 9)):
        labels = np.full(grid.shape, 3)
        labels[8:16, 12:20, 8:16], labels[8:16, 4:wall, 4:20] = 1, 2
        write_label_image(tmp_path / f"{name}.nii.gz", LabelImage(labels, grid))
    (tmp_path / "names.json").write_text(json.dumps({"1": "prostate", "2": "rectum", "3": "body"}))
    return tmp_path
