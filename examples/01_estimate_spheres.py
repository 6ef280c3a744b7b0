"""The stiffness of a shell around a cavity, from one label image before and one after the cavity has grown.

The images are made here, from a phantom whose shell has 30 kPa; with images of your own, start at `read_case`.
"""

from __future__ import annotations

import sys
import tempfile
from pathlib import Path

import palpate
from palpate.images.readers import write_label_image
from palpate.phantoms.spheres import SpheresOptions, spheres

CASE = """
[images]
before = "before.nii.gz"
after = ["after.nii.gz"]

[tissues]
cavity = { label = 1, role = "driver" }
shell = { label = 2, role = "estimate" }
surroundings = { label = "remaining", role = "known", youngs_modulus_kpa = 10.0 }

[mesh]
edge_length_mm = 8.0

[driver]
modes = 30

[noise]
surface_sd_mm = 0.15
correlation_length_mm = 3.0
"""


def write_case(folder: Path) -> Path:
    """Write both label images (1.5 mm voxels) and the case that names them."""
    scene = spheres(SpheresOptions(seed=1, kind="pushed", push_mm=4.0, spacing_mm=(1.5, 1.5, 1.5), truth_edge_mm=5.0))
    write_label_image(folder / "before.nii.gz", scene.before)
    write_label_image(folder / "after.nii.gz", scene.after)
    (folder / "case.toml").write_text(CASE)
    return folder / "case.toml"


def main() -> float:
    """Estimate, print what was found, and give the shell's Young's modulus (kPa)."""
    with tempfile.TemporaryDirectory() as folder:
        result = palpate.estimate(palpate.read_case(write_case(Path(folder))))
    for e in result.estimation.estimates:
        low, high = e.interval95
        sys.stdout.write(f"{e.tissue}: {e.value:.1f} kPa (95 %: {low:.1f} to {high:.1f} kPa), {e.verdict}: {e.why}\n")
        assert low < 30.0 < high
    return result.estimation.estimates[0].value


if __name__ == "__main__":
    main()
