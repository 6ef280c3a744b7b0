"""A bar of "what would change this answer" that leaves the interval is a warning, which names bar and tissue."""

from __future__ import annotations

import math

import pytest

from palpate.findings import one_a_cause
from palpate.statement.estimate_findings import variation_findings
from palpate.statement.estimation import ModulusEstimate
from palpate.statement.variations import DOWN, UP, Variation, ratio_change


def modulus(tissue, *, verdict="identified", interval=(16.0, 25.0), ratio_interval=(1.6, 2.5)):
    return ModulusEstimate(
        tissue, "kPa", 20.0, interval, "linearised", "fat", 2.0, ratio_interval, verdict, "", parameter="youngs_modulus"
    )


def changed(cause, subject, setting, **factors):
    return Variation(cause, subject, setting, "linearised", {name: math.log(by) for name, by in factors.items()})


def test_a_bar_that_leaves_the_interval_is_named_with_its_tissue_and_farthest_setting():
    bars = (
        changed("law", "", "linear", gland=1.3, muscle=1.1),
        changed("law", "", "mooney-rivlin", gland=1.6, muscle=0.95),
        changed("frame", "", "held still", gland=1.05, muscle=0.9),
    )
    (finding,) = variation_findings(bars, [modulus("gland"), modulus("muscle")])
    assert (finding.code, finding.about) == ("beyond-interval", "material law")
    assert "Material law, mooney-rivlin: 'gland' would have 32 kPa, outside 16 to 25" in finding.message
    assert "muscle" not in finding.message


def test_one_assumption_is_one_line_that_names_every_tissue():
    both = variation_findings(
        [changed("frame", "", "held still", gland=0.5, muscle=2.0)], [modulus("gland"), modulus("muscle")]
    )
    (line,) = one_a_cause(both)
    assert "'gland' would have 10 kPa" in line.message
    assert "also 'muscle' would have 40 kPa, outside 16 to 25. State" in line.message
    assert len(line.message.split()) <= 60


@pytest.mark.parametrize(
    ("verdict", "intervals"),
    [("not identified", (None, None)), ("identified", ((None, None), (None, None)))],
)
def test_what_has_no_interval_or_an_open_one_is_left_by_nothing(verdict, intervals):
    of = modulus("gland", verdict=verdict, interval=intervals[0], ratio_interval=intervals[1])
    assert variation_findings([changed("law", "", "linear", gland=9.0)], [of]) == ()


def test_a_bar_without_an_estimate_says_nothing():
    assert variation_findings([Variation("law", "", "linear", "linearised", None, reason="none")], [modulus("a")]) == ()


def test_a_known_modulus_that_is_varied_moves_no_ratio_to_it():
    bars = [changed("known_modulus", "fat", words, gland=by) for words, by in ((DOWN, 1 / 1.2), (UP, 1.2))]
    tight = modulus("gland", verdict="ratio only", interval=(10.0, 40.0), ratio_interval=(1.9, 2.1))
    assert variation_findings(bars, [tight]) == ()
    for bar in bars:
        of = bar.cause, bar.subject, bar.setting
        assert ratio_change(bar.changes["gland"], *of, relative_to="fat") == pytest.approx(0.0)
        assert ratio_change(bar.changes["gland"], *of, relative_to="bone") == bar.changes["gland"]
    identified = modulus("gland", interval=(19.0, 21.0))
    assert len(variation_findings(bars, [identified])) == 1
