"""Colour scales: their ticks lie on them, and who sees no red or green can still read them."""

from __future__ import annotations

import numpy as np
import pytest

from palpate.report.scales import Scale, angle_scale, distance_scale, strain_scale


@pytest.mark.parametrize("scale", [angle_scale(), strain_scale()])
def test_a_scale_from_bad_to_good_can_be_told_by_its_brightness_alone(scale):
    linear = (scale.table / 255.0) ** 2.2
    luminance = linear @ [0.2126, 0.7152, 0.0722]
    slope = np.diff(luminance)
    assert (slope > -0.004).all() or (slope < 0.004).all()  # tables of 8 bits are not smooth to the last one
    assert abs(luminance[-1] - luminance[0]) > 0.4


@pytest.mark.parametrize("scale", [distance_scale(1.5), angle_scale()])
def test_ticks_lie_on_their_scale(scale):
    places = [float(scale.place(value)) for value, _ in scale.ticks]
    assert places == sorted(places)
    assert min(places) >= 0.0
    assert max(places) <= 1.0


def test_a_logarithmic_scale_has_its_middle_at_the_geometric_mean():
    scale = Scale("viridis", 1.0, 100.0, True, "", ())
    assert float(scale.place(10.0)) == pytest.approx(0.5)


def test_the_distance_scale_is_symmetric_and_marks_the_voxel():
    scale = distance_scale(1.5)
    assert scale.low == -scale.high == -3.0
    assert {-1.5, 1.5} <= {value for value, _ in scale.ticks}
