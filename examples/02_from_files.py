"""Make a mesh from label images on disk: this shows the files, the case, and the quality of the mesh.

A ball, the organ, lies beside a hollow tube, the driver. The asserted number is the ball's volume in the mesh over its
true volume. Voxels are 2 mm wide, and smoothing over 1.2 mm shrinks a radius R by about 1.2^2 / R mm, in both images.
"""

from __future__ import annotations

import sys
import tempfile
from pathlib import Path

import numpy as np

from palpate import make_mesh, read_case
from palpate.images import LabelImage, VoxelGrid, write_label_image

RADIUS, VOXEL = 15.0, 2.0
CASE = """
images = { before = "before.nii.gz", after = ["after.nii.gz"] }
[tissues]
organ = { label = 1, role = "estimate", poisson_ratio = 0.45 }
tube = { label = 2, role = "driver" }
surroundings = { label = "remaining", role = "known", youngs_modulus_kpa = 10.0 }
[mesh]
edge_length_mm = 6.0
"""


def write_case(folder: Path) -> Path:
    """Write both images and the case; in the later state the tube is 2 mm wider, and the organ 2 mm further away."""
    grid = VoxelGrid((40, 44, 36), np.diag([VOXEL, VOXEL, VOXEL, 1.0]))
    at = np.stack(np.meshgrid(*map(np.arange, grid.shape), indexing="ij"), -1) * VOXEL
    for name, more in (("before", 0.0), ("after", 2.0)):
        labels = np.zeros(grid.shape, dtype=np.int32)
        labels[np.linalg.norm(at - [39.3, 54.6 + more, 34.7], axis=-1) < RADIUS] = 1
        labels[np.linalg.norm(at[..., :2] - [39.3, 25.2], axis=-1) < 8.0 + more] = 2
        write_label_image(folder / f"{name}.nii.gz", LabelImage(labels, grid))
    (folder / "case.toml").write_text(CASE)
    return folder / "case.toml"


def main() -> float:
    """Mesh the reference state, and return the organ's volume in the mesh over that of the ball."""
    with tempfile.TemporaryDirectory() as folder:
        tets = make_mesh(read_case(write_case(Path(folder)))).space.mesh
    corners = tets.nodes[tets.tets[tets.region == 0]]
    volume = np.linalg.det(corners[:, 1:] - corners[:, :1]).sum() / 6.0
    share = float(volume / (4.0 / 3.0 * np.pi * RADIUS**3))
    sys.stdout.write(f"{len(tets.tets)} tetrahedra; organ: {100 * share:.1f} % of the ball's volume\n")
    assert abs(share - 1.0) < 0.01
    return share


if __name__ == "__main__":
    main()
