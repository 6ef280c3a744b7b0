"""What maps say in words: a part that differs, none, or that the data cannot tell."""

from __future__ import annotations

import numpy as np

from palpate.statement.map_summary import map_findings, map_summary
from palpate.uncertainty import DifferentRegion, StiffnessMap


def map_of(resolved, region=None):
    n = np.zeros(4)
    return StiffnessMap("prostate", 0, np.arange(4), n, n + 0.2, n + resolved, 0.7, resolved, region)


def test_a_part_is_told_with_its_volume_place_contrast_and_probability():
    region = DifferentRegion(np.arange(2), 1.44, np.array([1.2, -30.4, 8.0]), 0.4, (0.3, 0.55), 0.9931)
    words = map_summary(map_of(0.8, region))
    for told in (
        "'prostate'",
        "1.4 mL",
        "(1, -30, 8) mm",
        "0.4 times",
        "0.3 to 0.55",
        "softer",
        "99.3 %",
        "its core is",
    ):
        assert told in words
    assert "stiffer" in map_summary(map_of(0.8, DifferentRegion(np.arange(2), 1.0, np.zeros(3), 3.0, (2.0, 4.0), 0.97)))


def test_no_part_is_another_thing_than_not_being_able_to_tell():
    assert "No part" in map_summary(map_of(0.8))
    assert "cannot tell" in map_summary(map_of(0.3))


def test_a_map_that_is_the_priors_is_warned_of():
    assert map_findings([map_of(0.8)]) == ()
    (finding,) = map_findings([map_of(0.8), map_of(0.3)])
    assert finding.code == "map-of-prior"
    assert "30%" in finding.message
