"""A known load and no known modulus: kilopascals all the same."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from case_texts import LINEAR, case_text
from palpate.case.case import CaseLoad
from palpate.case.file import read_case
from palpate.errors import ConfigurationError
from palpate.images.label_image import LabelImage, VoxelGrid
from palpate.images.readers import write_label_image
from palpate.images.segmentation import first_labels
from palpate.mechanics.element import largest_strains
from palpate.study.run import estimate
from palpate.study.simulate import simulate

CASE = case_text(
    {
        "bone": {"label": 1, "role": "rigid"},
        "gland": {"label": 2, "role": "estimate", "youngs_modulus_kpa": 16.0},
        "sac": {"label": [5, 3], "role": "estimate", "youngs_modulus_kpa": 8.0},
        "air": {"label": 0, "role": "void"},
    },
    after=None,
    images={"align": "none"},  # the simulation holds the bone
    loads=[{"kind": "gravity", "acceleration_m_s2": [3.0, 0.0, 0.0]}],  # as a table that tilts by 18 degrees does
    mechanics=LINEAR,
    mesh={"edge_length_mm": 5.0},
    estimate={"start_ratios": [4.0, 32.0]},  # kPa, for no tissue is known
)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A gland and a sac, one on the other, in the shape of a finger on a plate of bone.

    So slender that its tip moves by 6 mm, six voxels, while no strain passes 8 %: the linear law's range.
    """
    folder = tmp_path_factory.mktemp("finger")
    grid = VoxelGrid((34, 26, 62), np.diag([1.0, 1.0, 1.0, 1.0]))
    x, y, z = np.moveaxis(np.indices(grid.shape).astype(float), 0, 0)
    radius = np.hypot(x - 12.6, y - 12.3)
    finger = (radius < 8.0) & (z < 47.3) | (radius**2 + (z - 47.3) ** 2 < 8.0**2)
    labels = np.where(z < 6.5, 1, np.where(finger, np.where(z < 24.4, 2, 3), 0))
    write_label_image(folder / "before.nii.gz", LabelImage(labels.astype(np.int32), grid, {}))
    (folder / "case.toml").write_text(CASE)
    return folder


@pytest.fixture(scope="module")
def simulation(folder):
    return simulate(read_case(folder / "case.toml"), progress=lambda _: None)


@pytest.fixture(scope="module")
def case(folder, simulation):
    """The case with its simulated later image."""
    write_label_image(folder / "after.nii.gz", simulation.after)
    return read_case(folder / "case.toml", ["images.after=['after.nii.gz']"])


@pytest.fixture(scope="module")
def result(case):
    return estimate(case)


def test_the_load_moves_the_body_by_voxels_within_the_linear_range(simulation):
    displacement = simulation.displacements[-1]
    assert np.abs(displacement).max() > 5.0
    assert largest_strains(simulation.space, displacement).max() < 0.08


def test_a_simulated_image_has_the_numbers_of_the_label_table(simulation):
    assert first_labels(simulation.space.mesh.tissues).tolist() == [1, 2, 3, 0]
    assert set(np.unique(simulation.after.labels)) == {0, 1, 2, 3}


def test_a_known_load_gives_kilopascals_without_a_known_tissue(result):
    assert result.estimation.status == "converged"
    assert [e.unit for e in result.estimation.estimates] == ["kPa", "kPa"]
    assert [e.ratio for e in result.estimation.estimates] == [None, None]
    for estimated, truth in zip(result.estimation.estimates, (16.0, 8.0), strict=True):
        assert estimated.interval95[0] < truth < estimated.interval95[1]
        assert estimated.value == pytest.approx(truth, rel=0.15)
        assert estimated.verdict in ("identified", "weak")


def test_a_body_that_a_load_moves_is_not_said_to_stand_still(result):
    assert "motion-below-noise" not in [remark.code for remark in result.remarks]


def test_twice_the_load_on_the_same_images_is_twice_the_modulus(case, result):
    """Exact under the linear law. The search starts and ends at bounds twice as stiff, too: K u = f, all of it doubled.

    From other starts it stops elsewhere within its tolerance, some hundredths of a standard deviation away; from these
    a difference in the last digit can still end it one step earlier, at a decrement of 1e-5: 2e-4 of a modulus.
    """
    search = case.estimate
    doubled = replace(
        case,
        loads=(replace(case.loads[0], acceleration_m_s2=(6.0, 0.0, 0.0)),),
        estimate=replace(
            search,
            start_ratios=tuple(2.0 * start for start in search.start_ratios),
            bounds_ratio=tuple(2.0 * bound for bound in search.bounds_ratio),
        ),
    )
    found = estimate(doubled).estimation.estimates
    for twice, once in zip(found, result.estimation.estimates, strict=True):
        assert twice.value == pytest.approx(2.0 * once.value, rel=2e-4)
        assert twice.interval95 == pytest.approx(tuple(2.0 * end for end in once.interval95), rel=1e-3)


def test_each_load_acts_in_the_state_that_it_is_stated_for(folder, case):
    """The table tilted one way for the first later image, the other way for the second: the same moduli."""
    tilts = [CaseLoad("gravity", state=1, acceleration_m_s2=(3.0, 0.0, 0.0))]
    tilts += [CaseLoad("gravity", state=2, acceleration_m_s2=(0.0, -2.0, 0.0))]
    other = replace(case, images=replace(case.images, after=()), loads=(replace(tilts[1], state=None),))
    write_label_image(folder / "other.nii.gz", simulate(other, progress=lambda _: None).after)
    both = replace(case, images=replace(case.images, after=(*case.images.after, folder / "other.nii.gz")), loads=())
    both = replace(both, estimate=replace(case.estimate, start_ratios=(12.0,)))
    found = estimate(replace(both, loads=tuple(tilts)))
    for estimated, truth in zip(found.estimation.estimates, (16.0, 8.0), strict=True):
        assert estimated.value == pytest.approx(truth, rel=0.15)
    exchanged = tuple(replace(load, state=3 - load.state) for load in tilts)
    wrong = estimate(replace(both, loads=exchanged))
    organs = [[of for image in r.estimation.fits for of in image if of.tissue != "air"] for r in (wrong, found)]
    worst, best = (max(of.end.rms_mm for of in fits) for fits in organs)
    assert worst > 5.0 * best


@pytest.mark.parametrize(
    ("override", "words"),
    [
        ("loads=[{kind='gravity', state=2, acceleration_m_s2=[0,0,-9.81]}]", "has 1 later state"),
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
