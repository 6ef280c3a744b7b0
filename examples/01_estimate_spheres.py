"""Find the stiffness of two balls, one inside the other, from label images before and after a frame squeezes them.

The images are simulated, with 60 and 30 kPa. With images of your own, start at `read_case`.
"""

from __future__ import annotations

import sys
import tempfile
from pathlib import Path

import palpate
from palpate.images import write_label_image
from palpate.phantoms import SpheresOptions, spheres

TRUTH_KPA = {"core": 60.0, "shell": 30.0}
CASE = """
mechanics.law = "linear"  # the simulation is linear; leave this out for real images
discrepancy.layer_sd = 0.0  # no soft layer lies between these balls; leave this out unless you know that
[images]
before = "before.nii.gz"
after = ["after.nii.gz"]

[tissues]
core = { label = 1, role = "estimate" }
shell = { label = 2, role = "estimate" }
frame = { label = 3, role = "driver" }
surroundings = { label = "remaining", role = "known", youngs_modulus_kpa = 10.0 }

[mesh]
edge_length_mm = 8.0
[estimate]
start_ratios = [1.0, 4.0]
"""


def write_case(folder: Path) -> Path:
    """Write both label images (voxels of 1 mm) and the case that names them."""
    scene = spheres(SpheresOptions(seed=2, spacing_mm=(1.0, 1.0, 1.0), truth_edge_mm=4.0))
    write_label_image(folder / "before.nii.gz", scene.before)
    write_label_image(folder / "after.nii.gz", scene.after)
    (folder / "case.toml").write_text(CASE)
    return folder / "case.toml"


def main() -> float:
    """Estimate, print the result, and return the core's Young's modulus (kPa)."""
    with tempfile.TemporaryDirectory() as folder:
        result = palpate.estimate(palpate.read_case(write_case(Path(folder))))
    sys.stdout.write(f"{result}\n")
    for e in result.estimation.estimates:
        low, high = e.interval95  # None if it is not identified
        assert low < TRUTH_KPA[e.tissue] < high
    return result.estimation.estimates[0].value


if __name__ == "__main__":
    main()
