"""A body at finite strain through the main job: the default law finds its moduli."""

from __future__ import annotations

import numpy as np
import pytest

from palpate.images.readers import write_label_image
from palpate.phantoms.spheres import SpheresOptions, spheres
from palpate.study.case_file import read_case
from palpate.study.run import estimate

LAW = "neo-hookean"
TRUTH_KPA = {"core": 60.0, "shell": 30.0}
CASE = """
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
[driver]
modes = 20
[estimate]
start_ratios = [3.0]
"""


def squeezed(folder, seed):
    """The case of neo-Hookean balls in a frame of 30 mm radius that squeezes and stretches them by up to 7 mm."""
    scene = spheres(SpheresOptions(seed, spacing_mm=(1.5,) * 3, truth_edge_mm=6.0, push_mm=7.0, law=LAW))
    write_label_image(folder / "before.nii.gz", scene.before)
    write_label_image(folder / "after.nii.gz", scene.after)
    (folder / "case.toml").write_text(CASE)
    return folder / "case.toml"


@pytest.mark.parametrize(("seed", "samples"), [(1, 200), (2, 0), (3, 0)])
def test_the_default_law_finds_the_moduli_of_a_body_at_finite_strain(seed, samples, tmp_path):
    result = estimate(read_case(squeezed(tmp_path, seed), [f"estimate.samples={samples}"]))
    assert (result.case.mechanics.law, result.case.mechanics.element) == (LAW, "auto")
    assert result.estimation.status == "converged"
    for found in result.estimation.estimates:
        truth = TRUTH_KPA[found.tissue]
        assert found.interval95[0] < truth < found.interval95[1]
        assert found.value == pytest.approx(truth, rel=0.15)
    assert "linear-strains" not in {remark.code for remark in result.remarks}
    if samples:
        assert_samples_spread_as_the_intervals(result.estimation)


def assert_samples_spread_as_the_intervals(estimation):
    chains = np.log(estimation.samples.moduli)  # on the expansion with the linear law's curvature
    sd = np.sqrt(np.diag(estimation.covariance.total))
    ends = np.log([found.interval95 for found in estimation.estimates])  # which hold layers held and free
    assert np.all(np.quantile(chains, 0.025, axis=(0, 1)) > ends[:, 0] - 0.2 * sd)
    assert np.all(np.quantile(chains, 0.975, axis=(0, 1)) < ends[:, 1] + 0.2 * sd)
    assert chains.std(axis=(0, 1)) == pytest.approx(sd, rel=0.35)
