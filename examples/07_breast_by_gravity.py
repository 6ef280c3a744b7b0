"""Find the moduli of fat and gland in a breast from a prone and a supine image: gravity is the known load.

The images are simulated on a finer mesh. For a real breast leave the law out; the run then takes minutes.
"""

import sys
import tempfile
from pathlib import Path

import numpy as np

import palpate
from palpate.images import LabelImage, VoxelGrid, write_label_image

CASE = """
images = { before = "prone.nii.gz"AFTER }
domain.outer_boundary = "fixed"  # the images end in the chest's wall, which does not move
mechanics.law = "linear"
mesh.edge_length_mm = EDGE
estimate = { starts_kpa = [6.0], bounds_kpa = [0.2, 100.0] }
[tissues]
gland = { label = 1, role = "estimate", youngs_modulus_kpa = 10.0 }
fat = { label = 2, role = "estimate", youngs_modulus_kpa = 4.0 }
chest = { label = 3, role = "rigid" }
air = { label = 0, role = "void" }
[[loads]]
kind = "gravity"
state = 0
acceleration_m_s2 = [0.0, 9.81, 0.0]  # prone: the front hangs down
[[loads]]
kind = "gravity"
state = 1
acceleration_m_s2 = [0.0, -9.81, 0.0]  # supine
"""


def main() -> float:
    """Simulate both images, estimate, print the result, and return the modulus of the gland (kPa)."""
    grid = VoxelGrid((50, 32, 50), np.diag([2.0, 2.0, 2.0, 1.0]))
    x, y, z = 2.0 * np.indices(grid.shape) - np.reshape([49.1, 9.3, 48.7], (3, 1, 1, 1))
    labels = np.where((x / 40) ** 2 + (y / 42) ** 2 + (z / 40) ** 2 < 1.0, 2, 0)
    labels[(x / 18) ** 2 + ((y - 18) / 14) ** 2 + (z / 18) ** 2 < 1.0] = 1
    labels[y <= 0.0] = 3
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        write_label_image(folder / "prone.nii.gz", LabelImage(labels.astype(np.int32), grid))
        (folder / "truth.toml").write_text(CASE.replace("AFTER", "").replace("EDGE", "8.0"))
        truth = palpate.simulate(palpate.read_case(folder / "truth.toml"))
        write_label_image(folder / "supine.nii.gz", truth.after)
        (folder / "case.toml").write_text(CASE.replace("AFTER", ', after = ["supine.nii.gz"]').replace("EDGE", "10.0"))
        result = palpate.estimate(palpate.read_case(folder / "case.toml"))
    sys.stdout.write(f"{result}\n")
    return result.estimation.estimates[0].value


if __name__ == "__main__":
    main()
