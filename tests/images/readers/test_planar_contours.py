"""Contours made voxels: as many, and where, as the body has that was drawn, on whichever planes, however often."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from palpate.images.readers.planar_contours import EMPTY, INTERPOLATED, JOINED, body, distinct

SHAPE = (24, 30, 34)
CENTRE, RADII = np.array([11.3, 14.2, 16.6]), np.array([8.4, 9.1, 7.7])
TURN = np.linspace(0.0, 2.0 * np.pi, 90, endpoint=False)
CIRCLE = np.stack([np.cos(TURN), np.sin(TURN)], axis=1)


def ellipse(height: float, scale: float = 1.0) -> NDArray[np.float64]:
    return CENTRE[1:] + CIRCLE * RADII[1:] * scale * np.sqrt(1.0 - ((height - CENTRE[0]) / RADII[0]) ** 2)


def planes(first: float, step: float) -> NDArray[np.float64]:
    heights = np.arange(first, SHAPE[0], step)
    return heights[np.abs(heights - CENTRE[0]) < 0.999 * RADII[0]]


TRUTH = ((np.stack(np.indices(SHAPE), axis=-1) - CENTRE) ** 2 / RADII**2).sum(axis=-1) < 1.0


@pytest.mark.parametrize("step", [0.5, 1.0, 1.5, 2.0, 2.5])
@pytest.mark.parametrize("shift", [0.0, 0.25, 0.5, 0.75])
def test_a_body_has_its_volume_and_its_place_on_whichever_planes_it_was_drawn(step: float, shift: float) -> None:
    heights = planes(shift, step)
    inside, noted = body(heights, [[ellipse(h)] for h in heights], SHAPE, exclusive=False)
    assert np.count_nonzero(inside) == pytest.approx(np.count_nonzero(TRUTH), rel=0.05)
    tolerance = 0.02 + 0.07 * step  # the planes themselves lie unevenly about the middle
    np.testing.assert_allclose(np.argwhere(inside).mean(axis=0), CENTRE, atol=tolerance)
    drawn = np.abs(heights[:, None] - np.arange(SHAPE[0])).min(axis=0) < 0.01
    held = (np.arange(SHAPE[0]) > heights[0]) & (np.arange(SHAPE[0]) < heights[-1])
    assert noted == {INTERPOLATED: np.flatnonzero(held & ~drawn).tolist(), EMPTY: [], JOINED: []}


@pytest.mark.parametrize(
    ("missing", "filled"), [((11,), True), ((11, 12), True), ((8, 13), True), ((9, 10, 11), False)]
)
def test_slices_that_were_not_drawn_are_filled_or_left_and_named(missing: tuple[int, ...], filled: bool) -> None:
    heights = np.array([h for h in planes(0.0, 1.0) if h not in missing])
    inside, noted = body(heights, [[ellipse(h)] for h in heights], SHAPE, exclusive=False)
    assert noted[INTERPOLATED if filled else EMPTY] == list(missing)
    assert sum(map(len, noted.values())) == len(missing)
    sizes = np.count_nonzero(inside[list(missing)], axis=(1, 2))
    if filled:
        assert sizes == pytest.approx(np.count_nonzero(TRUTH[list(missing)], axis=(1, 2)), rel=0.05)
    else:
        assert not sizes.any()


@pytest.mark.parametrize(
    "copy",
    [
        lambda contour: contour,
        lambda contour: np.roll(contour, 17, axis=0),
        lambda contour: contour[::-1],
        lambda contour: np.round(contour, 1),
        lambda contour: np.vstack([contour, contour[:1]]),
    ],
)
def test_a_contour_and_its_copy_are_one(copy) -> None:
    contour = ellipse(11.0)
    assert distinct([contour, ellipse(11.0, 0.5), copy(contour)])[:1] == [contour]
    assert len(distinct([contour, ellipse(11.0, 0.5), copy(contour)])) == 2
    assert len(distinct([contour, copy(contour) + 0.5])) == 2


def test_a_contour_in_another_is_a_hole_and_one_in_that_an_island() -> None:
    rings = [ellipse(11.0, scale) for scale in (0.3, 1.0, 0.6)]
    inside, noted = body(np.array([11.0]), [rings], SHAPE, exclusive=False)
    y, x = (np.indices(SHAPE[1:]) - CENTRE[1:, None, None]) / RADII[1:, None, None]
    far = np.hypot(x, y) / np.sqrt(1.0 - (0.3 / RADII[0]) ** 2)
    expected = (far < 0.3) | ((far > 0.6) & (far < 1.0))
    assert np.array_equal(inside[11], expected)
    assert noted[JOINED] == []
    assert np.array_equal(body(np.array([11.0]), [rings], SHAPE, exclusive=True)[0], inside)


def test_contours_that_cross_are_joined_and_told_or_exclude_each_other_where_the_file_says_so() -> None:
    first, second = ellipse(11.0), np.add(ellipse(11.0), [0.0, 5.0])
    one, other = (body(np.array([11.0]), [[each]], SHAPE, exclusive=False)[0] for each in (first, second))
    joined, apart = (body(np.array([11.0]), [[first, second]], SHAPE, exclusive=way) for way in (False, True))
    assert (joined[1][JOINED], apart[1][JOINED]) == ([11], [])
    assert np.array_equal(joined[0], one | other)
    assert np.array_equal(apart[0], one ^ other)
