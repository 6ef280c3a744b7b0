"""Colours of tissues: the user's own where they can be seen, else ours, and never the same twice for organs."""

from __future__ import annotations

import pytest

from palpate.images.tissue import Role, Tissue
from palpate.report.colours import tissue_colours
from palpate.report.scales import Scale, angle_scale, distance_scale


def tissue(colour):
    return Tissue("a", Role.ESTIMATE, (1,), colour=colour)


def test_a_tissues_own_colour_is_kept():
    assert tissue_colours((tissue("#12AB9f"),)) == ("#12ab9f",)


@pytest.mark.parametrize("colour", [None, "#000000", "#0a0f20"])
def test_what_cannot_be_seen_is_replaced(colour):
    assert tissue_colours((tissue(colour),)) == ("#e69f00",)


def test_organs_without_colours_differ():
    tissues = tuple(Tissue(str(i), Role.ESTIMATE, (i,)) for i in range(1, 8))
    assert len(set(tissue_colours(tissues))) == 7


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
