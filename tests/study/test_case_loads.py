"""A known load and no known modulus: kilopascals all the same."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from palpate.errors import ConfigurationError
from palpate.images.label_image import LabelImage, VoxelGrid
from palpate.images.readers import write_label_image
from palpate.study.case_file import read_case
from palpate.study.run import estimate, simulate

CASE = """
[images]
before = "before.nii.gz"
align = "none"  # the simulation holds the bone

[tissues.bone]
label = 1
role = "rigid"

[tissues.gland]
label = 2
role = "estimate"
youngs_modulus_kpa = 8.0

[tissues.sac]
label = 3
role = "estimate"
youngs_modulus_kpa = 16.0

[tissues.air]
label = 0
role = "void"

[[loads]]
kind = "gravity"
acceleration_m_s2 = [6.0, 0.0, 0.0]

[mechanics]
law = "linear"
element = "P1"

[mesh]
edge_length_mm = 5.0
"""


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A gland and a sac, one on the other, in the shape of a thumb on a plate of bone."""
    folder = tmp_path_factory.mktemp("thumb")
    grid = VoxelGrid((36, 36, 44), np.diag([1.0, 1.0, 1.0, 1.0]))
    x, y, z = np.moveaxis(np.indices(grid.shape).astype(float), 0, 0)
    radius = np.hypot(x - 17.6, y - 17.3)
    thumb = (radius < 12.0) & (z < 26.3) | (radius**2 + (z - 26.3) ** 2 < 12.0**2)
    labels = np.where(z < 6.5, 1, np.where(thumb, np.where(z < 15.4, 2, 3), 0))
    write_label_image(folder / "before.nii.gz", LabelImage(labels.astype(np.int32), grid, {}))
    (folder / "case.toml").write_text(CASE)
    return folder


@pytest.fixture(scope="module")
def result(folder):
    case = read_case(folder / "case.toml")
    write_label_image(folder / "after.nii.gz", simulate(case, progress=lambda _: None).after)
    return estimate(replace(case, images=replace(case.images, after=(folder / "after.nii.gz",))))


def test_a_known_load_gives_kilopascals_without_a_known_tissue(result):
    assert result.estimation.status == "converged"
    assert [e.unit for e in result.estimation.estimates] == ["kPa", "kPa"]
    assert [e.ratio for e in result.estimation.estimates] == [None, None]
    for estimated, truth in zip(result.estimation.estimates, (8.0, 16.0), strict=True):
        assert estimated.interval95[0] < truth < estimated.interval95[1]

    gland = result.estimation.estimates[0]
    assert gland.value == pytest.approx(8.0, rel=0.4)


def test_twice_the_load_on_the_same_images_is_twice_the_modulus(folder, result):
    case = read_case(folder / "case.toml", ["images.after=['after.nii.gz']"])
    doubled = replace(case, loads=(replace(case.loads[0], acceleration_m_s2=(12.0, 0.0, 0.0)),))
    found = estimate(doubled).estimation.estimates
    for twice, once in zip(found, result.estimation.estimates, strict=True):
        assert twice.value == pytest.approx(2.0 * once.value, rel=1e-2)


@pytest.mark.parametrize(
    ("override", "words"),
    [
        ("loads=[{kind='pressure', surface='air'}]", "needs the key 'pressure_kpa'"),
        ("loads=[{kind='gravity', surface='air', acceleration_m_s2=[0,0,-9.81]}]", "a gravity has no 'surface'"),
        ("loads=[{kind='push'}]", "did you mean"),
    ],
)
def test_a_load_that_makes_no_sense_is_refused_by_its_key(folder, override, words):
    with pytest.raises(ConfigurationError, match=words):
        read_case(folder / "case.toml", [override])


@pytest.mark.parametrize(("surface", "words"), [("bone", "is prescribed"), ("wind", "those that can be loaded are")])
def test_a_surface_that_cannot_be_loaded_is_refused(folder, surface, words):
    case = read_case(folder / "case.toml", [f"loads=[{{kind='pressure', surface='{surface}', pressure_kpa=1.0}}]"])
    with pytest.raises(ConfigurationError, match=words):
        simulate(case, progress=lambda _: None)
