"""A body at finite strain through the main job: the default law finds its moduli, the linear one warns of its range."""

from __future__ import annotations

import numpy as np
import pytest

from case_texts import BALLS, case_text
from palpate.case.file import read_case
from palpate.images.readers import write_label_image
from palpate.phantoms.spheres import SpheresOptions, spheres
from palpate.study.run import estimate

TRUTH_KPA = {"core": 60.0, "shell": 30.0}
VALLEY = 3  # the body whose posterior is a valley: 4 000 draws are two dozen effective ones, which tell of no quantile
CASE = case_text(BALLS, mesh={"edge_length_mm": 8.0}, driver={"modes": 20}, estimate={"start_ratios": [3.0]})


@pytest.fixture(scope="module", params=[1, 2, 3])
def case(request, tmp_path_factory):
    """Neo-Hookean balls in a frame of 30 mm radius that squeezes and stretches them by up to 7 mm."""
    folder = tmp_path_factory.mktemp("balls")
    options = SpheresOptions(
        seed=request.param, spacing_mm=(1.5,) * 3, truth_edge_mm=6.0, push_mm=7.0, law="neo-hookean"
    )
    scene = spheres(options)
    write_label_image(folder / "before.nii.gz", scene.before)
    write_label_image(folder / "after.nii.gz", scene.after)
    (folder / "case.toml").write_text(CASE)
    return folder / "case.toml"


def test_the_default_law_finds_the_moduli_of_a_body_at_finite_strain(case):
    result = estimate(read_case(case, ["estimate.samples=4000"]))
    assert (result.case.mechanics.law, result.case.mechanics.element) == ("neo-hookean", "auto")
    assert result.estimation.status == "converged"
    for found in result.estimation.estimates:
        truth = TRUTH_KPA[found.tissue]
        assert found.interval95[0] < truth < found.interval95[1]
        assert found.value == pytest.approx(truth, rel=0.15)
    assert "linear-strains" not in {remark.code for remark in result.remarks}
    samples = result.estimation.samples
    drawn = np.log(samples.moduli)  # on the expansion with the linear law's curvature
    sd = np.sqrt(np.diag(result.estimation.covariance.total))
    ends = np.log([found.interval95 for found in result.estimation.estimates])
    assert drawn.std(axis=0) == pytest.approx(sd, rel=0.35)
    assert np.quantile(drawn, 0.025, axis=0) == pytest.approx(ends[:, 0], abs=0.2 * sd.max())
    assert np.quantile(drawn, 0.975, axis=0) == pytest.approx(ends[:, 1], abs=0.2 * sd.max())


@pytest.mark.parametrize("case", [1], indirect=True)
def test_the_linear_law_is_warned_of_beyond_its_range(case):
    coarse = ["mesh.edge_length_mm=12", "driver.modes=12", "discrepancy.layer_sd=0"]
    result = estimate(read_case(case, ["mechanics={law='linear', element='P1'}", *coarse]))
    assert "linear-strains" in {remark.code for remark in result.remarks}
