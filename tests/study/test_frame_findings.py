"""A motion of the whole is named, with what was done about it."""

from __future__ import annotations

import numpy as np
import pytest

from bodies import ELSEWHERE, STILL, body
from palpate.body.imaged import brought
from palpate.images.alignment import RigidMotion


def codes(after, method: str) -> list[str]:
    found = brought(body(STILL), (after,), method=method)
    assert (found.later[0].alignment is None) == (method == "none")
    return [finding.code for finding in found.findings]


@pytest.mark.parametrize(("method", "code"), [("none", "frame-moves"), ("surfaces", "frame-aligned")])
def test_a_motion_of_the_whole_is_told_with_what_was_done_about_it(method, code):
    assert codes(body(ELSEWHERE, filling=3.0, seed=1), method) == [code]


@pytest.mark.parametrize("method", ["none", "surfaces"])
def test_organs_that_move_in_a_frame_that_stands_still_are_not_told_of(method):
    assert codes(body(STILL, filling=6.0, seed=1), method) == []


def test_a_shift_of_two_millimetres_is_named_where_the_case_says_that_nothing_moved():
    shift = RigidMotion(np.eye(3), np.array([0.0, 1.8, 0.0]))
    found = brought(body(STILL), (body(shift, filling=3.0, seed=1),), method="none")
    (finding,) = found.findings
    assert finding.code == "frame-moves"
    assert 'images.align = "surfaces"' in finding.message
