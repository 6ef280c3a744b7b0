"""Simulate a later state: fill a tube by 3 mm beside an organ of known stiffness, and make its label image.

`[motion]` replaces the motion of the driver that a later image would show. Where the tube fills most, its wall moves by
3 mm at the mean radius, and in proportion to the distance from the middle line. The asserted number is the largest
displacement.
"""

from __future__ import annotations

import sys
import tempfile
from pathlib import Path

import numpy as np

from palpate import read_case, simulate
from palpate.images import LabelImage, VoxelGrid, write_label_image

CASE = """
images = { before = "before.nii.gz", after = ["shifted.nii.gz"] }
motion = { filling_mm = 3.0 }
[tissues]
organ = { label = 1, role = "estimate", youngs_modulus_kpa = 30.0 }
tube = { label = 2, role = "driver" }
surroundings = { label = "remaining", role = "known", youngs_modulus_kpa = 10.0 }
[mesh]
edge_length_mm = 8.0
"""


def write_case(folder: Path) -> Path:
    """Write a ball of 14 mm radius, 5 mm from a tube of 8 mm radius that runs through the image; voxels of 2 mm."""
    grid = VoxelGrid((40, 44, 36), np.diag([2.0, 2.0, 2.0, 1.0]))
    at = np.stack(np.meshgrid(*map(np.arange, grid.shape), indexing="ij"), -1) * 2.0
    for name, shift in (("before", 0.0), ("shifted", 2.0)):
        labels = np.zeros(grid.shape, dtype=np.int32)
        labels[np.linalg.norm(at - [39.3, 52.0 + shift, 34.7], axis=-1) < 14.0] = 1
        labels[np.linalg.norm(at[..., :2] - [39.3, 25.2], axis=-1) < 8.0] = 2
        write_label_image(folder / f"{name}.nii.gz", LabelImage(labels, grid))
    (folder / "case.toml").write_text(CASE)
    return folder / "case.toml"


def main() -> float:
    """Simulate, and return the largest displacement (mm)."""
    with tempfile.TemporaryDirectory() as folder:
        result = simulate(read_case(write_case(Path(folder))))
    largest = float(np.linalg.norm(result.displacements[-1], axis=1).max())
    changed = np.count_nonzero(result.before.labels != result.after.labels)
    sys.stdout.write(f"largest displacement {largest:.2f} mm; {changed} voxels changed their label\n")
    assert abs(largest - 3.1) < 0.1  # 3 mm at the tube's mean radius, a little more where its wall lies further out
    return largest


if __name__ == "__main__":
    main()
