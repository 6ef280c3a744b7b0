"""Without bones the motion of the whole is found among organs that move by themselves; none is found where none is."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest

from bodies import ELSEWHERE, STILL, body
from palpate.errors import InputDataError
from palpate.images.alignment import RigidFit, RigidMotion, moved
from palpate.images.registration import registration
from palpate.images.segmentation import Segmentation
from palpate.images.surface_alignment import align_surfaces, surface_maps


def aligned(before: Segmentation, after: Segmentation) -> RigidFit:
    return align_surfaces(before, surface_maps(before, after))


def error(found: RigidMotion, truth: RigidMotion) -> tuple[float, float]:
    """Of the place of the organs' centre, mm, and of the turn, degrees."""
    wrong = found.compose(truth.inverse())
    place = truth.apply(np.array([[1.0, 7.0, 0.0]]))
    return float(np.linalg.norm(wrong.apply(place) - place)), wrong.angle_deg


@cache
def fit_of_a_whole(skin):
    """Of a body whose organs move with it."""
    return aligned(body(STILL, skin=skin), body(ELSEWHERE, skin=skin, seed=1))


@pytest.mark.parametrize("skin", [True, False])
def test_a_body_that_moves_as_a_whole_is_found_to_fractions_of_a_voxel(skin):
    fit = fit_of_a_whole(skin)
    shift, turn = error(fit.motion, ELSEWHERE)
    assert shift < 0.25
    assert turn < 0.8
    assert fit.rms_mm < 0.5


@pytest.mark.parametrize("filling", [3.0, 6.0])
@pytest.mark.parametrize("skin", [True, False])
def test_organs_that_move_by_themselves_do_not_hide_the_motion_of_the_whole(filling, skin):
    fit = aligned(body(STILL, skin=skin), body(ELSEWHERE, filling=filling, skin=skin, seed=1))
    shift, turn = error(fit.motion, ELSEWHERE)
    assert shift < 1.2
    assert turn < 1.6


@pytest.mark.parametrize("filling", [0.0, 3.0, 6.0])
@pytest.mark.parametrize("skin", [True, False])
def test_organs_that_move_by_themselves_are_no_motion_of_the_whole(filling, skin):
    fit = aligned(body(STILL, skin=skin), body(STILL, filling=filling, skin=skin, seed=1))
    assert np.array_equal(fit.motion.matrix, np.eye(4))


def test_a_later_image_with_a_smaller_field_of_view_shows_the_same_motion():
    fit = aligned(body(STILL), body(ELSEWHERE, filling=3.0, field=(80.0, 84.0, 70.0), seed=1))
    shift, turn = error(fit.motion, ELSEWHERE)
    assert shift < 1.0
    assert turn < 2.5


def test_images_in_worlds_of_their_own_are_laid_on_each_other():
    away = RigidMotion(np.eye(3), np.array([150.0, -40.0, 300.0]))
    fit = aligned(body(STILL), moved(body(ELSEWHERE, filling=3.0, seed=1), away))
    shift, turn = error(fit.motion, away.compose(ELSEWHERE))
    assert shift < 1.0
    assert turn < 1.6


def test_the_motion_that_is_told_is_that_of_the_organs_wherever_the_world_begins():
    before, after = body(STILL), body(ELSEWHERE, seed=1)
    away = RigidMotion(np.eye(3), np.array([500.0, -300.0, 900.0]))
    there = moved(before, away), moved(after, away)
    told = [
        registration(before, surface_maps(before, after), fit_of_a_whole(True), by="surfaces").row("after"),
        registration(there[0], surface_maps(*there), aligned(*there), by="surfaces").row("after"),
    ]
    np.testing.assert_allclose(
        told[0]["translation_mm"], told[1]["translation_mm"], atol=0.4
    )  # of rounding which points count
    voxels = np.argwhere(before.index < 2).astype(float)
    centre = before.grid.world(voxels).mean(axis=0)
    np.testing.assert_allclose(told[0]["translation_mm"], ELSEWHERE.apply(centre[None])[0] - centre, atol=0.4)
    assert told[0]["rotation_deg"] == pytest.approx(ELSEWHERE.angle_deg, abs=0.8)
    assert set(told[0]["residual_by_tissue_mm"]) == {"prostate", "bladder", "rectum", "air"}
    assert max(told[0]["residual_by_tissue_mm"].values()) < 0.7


def test_images_that_show_no_surface_away_from_their_border_are_refused():
    small = body(STILL, field=(14.0, 14.0, 14.0))
    with pytest.raises(InputDataError, match="align = 'none'"):
        aligned(small, small)


def test_maps_of_the_earlier_image_that_are_known_from_another_later_one_are_those_made_anew():
    before, first, second = body(STILL), body(ELSEWHERE, seed=1), body(STILL, filling=3.0, seed=2)
    known = surface_maps(before, first)
    again, anew = surface_maps(before, second, known), surface_maps(before, second)
    assert list(again) == list(anew)
    for tissue in anew:
        assert again[tissue][0] is known[tissue][0]
        for one, other in zip(again[tissue], anew[tissue], strict=True):
            np.testing.assert_array_equal(one.map.coefficients, other.map.coefficients)
            np.testing.assert_array_equal(one.points.places, other.points.places)
