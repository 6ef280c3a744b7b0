"""What an estimate may be expected to tell: wider where images are worse, at the moduli that were guessed."""

from __future__ import annotations

from dataclasses import replace
from functools import cache, partial
from pathlib import Path

import numpy as np
import pytest

from palpate.body.body import make_body
from palpate.body.imaged import aligned
from palpate.case.case import Case, CaseTissue, Discrepancy, DriverMotion, Images, Mechanics, MeshSettings, Noise
from palpate.images.grey_field import GreyField
from palpate.images.segmentation import segment
from palpate.images.tissue import Role
from palpate.observation import DataFile, Landmarks, PointTable, stated_sd
from palpate.progress import silent
from palpate.study.prediction import predicted_intervals
from palpate.study.run import estimate_states
from palpate.uncertainty import NORMAL_95
from scenes import coarse_balls

GIVEN = {"core": 60.0, "shell": 30.0}


def case_of(scene, **changes):
    tissues = tuple(
        CaseTissue(t.name, t.labels or "remaining", t.role, youngs_modulus_kpa=GIVEN.get(t.name, t.youngs_modulus_kpa))
        for t in scene.tissues
    )
    return Case(
        "balls",
        images=Images(Path("before.nii.gz"), (Path("after.nii.gz"),)),
        tissues=tissues,
        mesh=MeshSettings(10.0),
        mechanics=Mechanics("linear", "P1"),
        driver=DriverMotion(modes=8),
        **changes,
    )


@pytest.fixture(scope="module")
def states():
    scene = coarse_balls()
    before, after = (segment(image, scene.tissues) for image in (scene.before, scene.after))
    return aligned(before, (after,), method="none")


@pytest.fixture(scope="module")
def prediction_of(states):
    body = make_body(states, case_of(coarse_balls()), progress=silent)
    return cache(lambda **changes: predicted_intervals([body], case_of(coarse_balls(), **changes), progress=silent))


def widths(prediction):
    return np.array([np.log(of.interval95[1] / of.interval95[0]) for of in prediction.moduli])


def noisy(sd_mm):
    """Where noise is most of what is unknown."""
    without = Discrepancy(0.0, 25.0, 0.0, layer_sd=0.05)
    return {"noise": Noise(surface_sd_mm=sd_mm, correlation_length_mm=6.0), "discrepancy": without}


def test_a_modulus_is_guessed_as_its_tissue_states_it(prediction_of):
    found = prediction_of()
    assert {of.tissue: of.guess for of in found.moduli} == pytest.approx(GIVEN)
    for of in found.moduli:
        low, high = of.interval95
        assert np.sqrt(low * high) == pytest.approx(of.guess, rel=1e-6)
        assert sum(of.shares.values()) == pytest.approx(1.0)
    assert not found.stated


@pytest.mark.parametrize(
    ("interval", "words"),
    [
        ((None, None), "95 % interval open at both ends (not identified)"),
        ((2.0, None), "95 % interval above 2 kPa (not identified)"),
        ((None, 9.0), "95 % interval below 9 kPa (not identified)"),
        ((2.0, 9.0), "95 % interval 2 to 9 kPa (not identified)"),
    ],
)
def test_an_open_end_is_told_in_words(prediction_of, interval, words):
    found = prediction_of()
    lines = replace(
        found, moduli=tuple(replace(of, interval95=interval, verdict="not identified") for of in found.moduli)
    ).lines()
    assert all(line.endswith(words) for line in lines)


def test_what_a_case_rules_out_has_no_share(states):
    case = case_of(coarse_balls(), discrepancy=Discrepancy(0.0, 25.0, 0.0, 0.0, layer_sd=0.0))
    found = predicted_intervals([make_body(states, case, progress=silent)], case, progress=silent)
    for of in found.moduli:
        assert set(of.shares) == {"noise", "driver", "grid", "mesh"}
        assert sum(of.shares.values()) == pytest.approx(1.0)


def test_twice_the_noise_makes_intervals_at_most_twice_as_wide(prediction_of):
    fine, coarse = (widths(prediction_of(**noisy(sd))) for sd in (0.1, 0.2))
    assert np.all(coarse > 1.2 * fine)
    assert np.all(coarse < 2.0 * fine * (1.0 + 1e-6))


def test_the_noise_that_a_case_states_is_that_of_the_prediction(prediction_of):
    found = prediction_of(**noisy(0.2))
    assert found.stated
    assert (found.noise_sd_mm, found.correlation_mm) == pytest.approx((0.2, 6.0))


def test_a_prediction_is_near_what_the_estimate_then_says(states, prediction_of):
    """Within a factor of two, of the standard deviations of a case whose truths are those that were guessed."""
    case = case_of(coarse_balls())
    sought = [replace(t, youngs_modulus_kpa=None) if t.role is Role.ESTIMATE else t for t in case.tissues]
    told = estimate_states((states,), replace(case, tissues=tuple(sought))).estimation
    sd = np.sqrt(np.diag(told.covariance.total))
    ratio = widths(prediction_of()) / (2.0 * NORMAL_95 * sd)
    assert np.all((ratio > 0.5) & (ratio < 2.0))


@pytest.fixture(scope="module")
def worth_of(states):
    """What each kind is worth, where points all over the body were measured with a standard deviation (mm) as well."""
    body_of = partial(make_body, case=case_of(coarse_balls()), progress=silent)

    def found(sd_mm):
        scene = coarse_balls()
        places, moved = scene.space.points[::7], scene.displacement[::7]
        file = DataFile("landmarks", "landmarks", (Path("markers.csv"),), 1, sd_mm)
        table = PointTable(places, places + moved, stated_sd(file, len(places)), ("",) * len(places), ())
        body = body_of(replace(states, data=(Landmarks(file, table),)))
        moduli = predicted_intervals([body], case_of(coarse_balls()), progress=silent).moduli
        return np.array([[of.wider["surface distance"], of.wider["landmarks"]] for of in moduli])

    return found


def test_one_kind_of_data_has_no_worth_of_its_own(prediction_of):
    assert [of.wider for of in prediction_of().moduli] == [{}, {}]


def test_data_are_worth_what_they_tell_beside_the_others(worth_of):
    """Points a thousand times worse than surfaces change nothing; the better they are, the less surfaces are worth."""
    useless, good, best = (worth_of(sd) for sd in (1e3, 0.3, 0.03))
    np.testing.assert_allclose(useless[:, 1], 1.0, atol=1e-3)
    assert np.all(useless[:, 0] > 2.0)
    assert np.all((best[:, 1] > good[:, 1]) & (good[:, 1] > 1.0))
    assert np.all(best[:, 0] < good[:, 0])


@pytest.mark.parametrize(("mean_mm", "low", "high"), [(1e3, 1.0, 1.001), (0.05, 1.5, np.inf)])
def test_a_field_from_grey_images_is_worth_what_its_error_allows(states, mean_mm, low, high):
    body = make_body(states, case_of(coarse_balls()), progress=silent)
    grey = [GreyField(name, 10.0, 1.0, mean_mm, mean_mm, at_least=False) for name in ("core", "shell", "surroundings")]
    grey = [of for of in grey if of.tissue in {tissue.name for tissue in body.space.mesh.tissues}]
    found = predicted_intervals([body], case_of(coarse_balls()), progress=silent, grey=grey)
    assert set(found.narrower) == set(GIVEN)
    assert all(low * (1.0 - 1e-6) <= factor < high for factor in found.narrower.values())
    assert ("hardly help" in found.lines()[-1]) == (mean_mm > 1.0)
